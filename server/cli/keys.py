"""`nafir keys`: make, list and revoke the API keys of a server."""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer

from server.core.command_line import StrictTyper
from server.core.errors import NafirError

app = StrictTyper(help="Make, list and revoke API keys. A running server takes changes over within a second or two.")

KeysFile = Annotated[
    Path, typer.Option("--file", envvar="NAFIR_KEYS_FILE", help="File of keys.", metavar="FILE", show_default=False)
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
_LONGEST_DAYS = 36_500


@app.command()
def create(
    file: KeysFile,
    scope: Annotated[
        list[str],
        typer.Option(
            help="What the key may do: listen, render, upload, metrics or admin; repeatable.", metavar="SCOPE"
        ),
    ],
    name: Annotated[str, typer.Option(help="Whose key it is.")] = "",
    days: Annotated[float | None, typer.Option(help="Days until the key expires. [default: never]")] = None,
    as_json: AsJson = False,
) -> None:
    """Make a key and print it. It is shown this once: the file holds a digest only."""
    from server.api.api_keys import SCOPES, create_key

    scopes = [each for each in SCOPES if each in scope]
    if unknown := sorted(set(scope) - set(SCOPES)):
        raise NafirError(f"--scope: {unknown[0]!r} is none of {', '.join(SCOPES)}")
    if days is not None and not 0 < days <= _LONGEST_DAYS:
        raise NafirError(f"--days: {days:g} is not between 0 and {_LONGEST_DAYS}")
    if len(name) > 100:
        raise NafirError("--name: has at most 100 characters")
    expires = None if days is None else (datetime.now(UTC) + timedelta(days=days)).replace(microsecond=0)
    key, entry = create_key(file, name, scopes, expires)
    typer.echo(json.dumps({"key": key, **entry.model_dump(mode="json", exclude={"sha256"})}) if as_json else key)


@app.command("list")
def list_keys(file: KeysFile, as_json: AsJson = False) -> None:
    """List the keys: ids, names, scopes and times, never the keys themselves."""
    from server.api.api_keys import ApiKeys

    keys = list(ApiKeys.read(file).by_id.values())
    if as_json:
        typer.echo(json.dumps({"keys": [key.model_dump(mode="json", exclude={"sha256"}) for key in keys]}))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("id", "name", "scopes", "created", "expires", title=f"{len(keys)} keys", title_justify="left")
    for key in keys:
        expires = "never" if key.expires is None else key.expires.isoformat(" ")
        table.add_row(key.id, key.name, " ".join(key.scopes), key.created.isoformat(" "), expires)
    Console().print(table)


@app.command()
def revoke(identifier: Annotated[str, typer.Argument(metavar="ID", help="Id of the key.")], file: KeysFile) -> None:
    """Revoke a key. Streams that it opened are closed."""
    from server.api.api_keys import revoke_key

    entry = revoke_key(file, identifier)
    typer.echo(f"revoked {entry.id} {entry.name}".rstrip())
