import importlib
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from server.core.command_line import StrictCommand, StrictTyper, require_at_most_one
from server.core.errors import NafirError

app = StrictTyper()


@app.command()
def tell(
    place: Annotated[str, typer.Argument()],
    yaw_deg: Annotated[float, typer.Option()] = 0.0,
    length_s: Annotated[float | None, typer.Option(min=0)] = None,
    size: Annotated[int, typer.Option("--size", "-s")] = 256,
    at: Annotated[list[float] | None, typer.Option()] = None,
    name: Annotated[list[str] | None, typer.Option()] = None,
    loop: Annotated[bool, typer.Option("--loop")] = False,
) -> None:
    typer.echo(repr((place, yaw_deg, length_s, size, at, name, loop)))


def run(*arguments):
    return CliRunner().invoke(app, [*arguments])


def test_numbers_and_repeatable_options_are_taken():
    outcome = run("here", "--yaw-deg", "-1.5e1", "-s", "24", "--at", "1", "--at", ".5", "--name", "0_1", "--name", "٣")
    assert outcome.stdout.strip() == "('here', -15.0, None, 24, [1.0, 0.5], ['0_1', '٣'], False)"


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (("--yaw-deg", "0_1"), "--yaw-deg"),
        (("--yaw-deg", "٣"), "--yaw-deg"),
        (("--yaw-deg=nan",), "--yaw-deg"),
        (("--length-s", "inf"), "--length-s"),
        (("--size", "1_0"), "--size"),
        (("-s", "2.0"), "--size"),
        (("--at", "1", "--at", "1e999"), "--at"),
    ],
)
def test_other_numbers_are_refused_by_the_name_of_the_option(arguments, option):
    outcome = run("here", *arguments)
    assert isinstance(outcome.exception, NafirError)
    assert str(outcome.exception).startswith(f"{option}: {arguments[-1].removeprefix('--yaw-deg=')!r} is ")


@pytest.mark.parametrize(
    "arguments", [("--yaw-deg", "90", "--yaw-deg", "0"), ("--size", "1", "-s", "1"), ("--loop", "--loop")]
)
def test_an_option_given_twice_is_refused(arguments):
    outcome = run("here", *arguments)
    assert isinstance(outcome.exception, NafirError)
    assert str(outcome.exception).startswith(f"{arguments[0]} is given 2 times")


def commands(group):
    for each in group.commands.values():
        yield from commands(each) if hasattr(each, "commands") else (each,)


@pytest.mark.parametrize("module", ["server.cli.main", "training.cli.main"])
def test_every_command_is_strict(module):
    found = list(commands(typer.main.get_command(importlib.import_module(module).app)))
    assert len(found) > 5
    assert all(isinstance(each, StrictCommand) for each in found)


INPUTS = {
    *("bundle", "clip", "costs", "file", "hrtf", "key", "path"),
    *("as_long_as", "data", "materials", "points", "predictions", "teacher"),
}
OUTPUTS = {"output", "figure"}
NEEDED = {"--listener": "1,1,1", "--emitter": "1,1,1", "--path": "absent.csv", "--output": "new.wav"}
"""Options that some commands cannot do without."""


def path_options(module):
    for command in commands(typer.main.get_command(importlib.import_module(module).app)):
        for parameter in command.params:
            kinds = str(getattr(getattr(parameter, "type_descriptor", None), "annotation", None))
            if parameter.param_type_name == "option" and "Path" in kinds:
                yield command, parameter


@pytest.mark.parametrize("module", ["server.cli.main", "training.cli.main"])
def test_every_command_looks_at_what_it_is_to_write_before_it_begins(module, tmp_path):
    """Nothing else is there that it would need: where it read or computed anything first, it would say so instead."""
    (tmp_path / "file").write_text("")
    found = list(path_options(module))
    assert {parameter.name for _, parameter in found} <= INPUTS | OUTPUTS
    written = [(command, parameter) for command, parameter in found if parameter.name in OUTPUTS]
    assert len(written) >= 4
    for command, parameter in written:
        given = {parameter.opts[0]: str(tmp_path / "file" / "x.png")}
        arguments = []
        for each in command.params:
            if each.required and each.param_type_name == "argument":
                arguments.append(str(tmp_path / "absent"))
            elif each.required:
                given.setdefault(each.opts[0], NEEDED[each.opts[0]])
        line = [*arguments, *(part for option in given.items() for part in option)]
        with pytest.raises(NafirError) as refused:
            command.main(line, standalone_mode=False)
        assert str(refused.value).startswith(f"{parameter.opts[0]}: "), command.name


def test_of_what_contradicts_each_other_all_is_named():
    require_at_most_one({"--a": True, "--b": False, "--c": False})
    with pytest.raises(NafirError, match=r"^--a and --c contradict each other: leave one out$"):
        require_at_most_one({"--a": True, "--b": False, "--c": True})
