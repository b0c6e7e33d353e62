"""The files of a scene bundle, as clients are told of them."""

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field

from server.scene.bundle import MANIFEST_FILE, Bundle


class BundleFile(BaseModel):
    """A file of a scene bundle."""

    model_config = ConfigDict(frozen=True)

    name: str
    bytes: Annotated[int, Field(ge=0)]
    sha256: str


class BundleFiles(BaseModel):
    """All files of a scene's bundle, the manifest first."""

    model_config = ConfigDict(frozen=True)

    scene: str
    files: tuple[BundleFile, ...]

    @classmethod
    def of(cls, bundle: Bundle) -> Self:
        digests = cls.digests(bundle).items()
        files = (BundleFile(name=name, bytes=len(bundle.contents[name]), sha256=digest) for name, digest in digests)
        return cls(scene=bundle.id, files=tuple(files))

    @staticmethod
    def digests(bundle: Bundle) -> dict[str, str]:
        """Return the SHA-256 of every file when the bundle was loaded."""
        return {MANIFEST_FILE: bundle.digest, **bundle.manifest.files}
