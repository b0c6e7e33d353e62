"""A stream through a sound card, by sounddevice (PortAudio)."""

from types import TracebackType
from typing import Any, Self

from nafir_client.errors import DeviceError, MissingExtraError
from nafir_client.threaded import ThreadedListener, ThreadedStream


class Player:
    """Plays what a stream's first listener hears, or another one, in `with`. `device` is a name or number of
    sounddevice's, by default the system's; `latency` is `low`, `high` or seconds. Raises MissingExtraError or
    DeviceError."""

    def __init__(
        self,
        stream: ThreadedStream | ThreadedListener,
        *,
        device: str | int | None = None,
        latency: str | float = "low",
    ) -> None:
        try:
            import sounddevice
        except ImportError as exc:
            raise MissingExtraError("sounddevice", "play", "playing") from exc
        except OSError as exc:
            raise DeviceError("device: there is no PortAudio; on Debian, apt-get install libportaudio2") from exc
        self._stream = stream
        try:
            self._output = sounddevice.OutputStream(
                samplerate=stream.output_rate,
                channels=stream.channels,
                dtype="float32",
                device=device,
                latency=latency,
                callback=self._fill,
            )
        except (sounddevice.PortAudioError, ValueError) as exc:
            raise DeviceError(f"device: {exc}") from exc

    def __enter__(self) -> Self:
        self._output.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._output.close()

    def _fill(self, out: Any, frames: int, time: object, status: object) -> None:  # noqa: ARG002  the caller's
        out[:] = self._stream.read(frames)
