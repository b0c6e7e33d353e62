"""`nafir plan-capacity`: what listeners need, and what breaks first."""

import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from server.bench.report import end_with, print_json, print_measures, print_rows
from server.core.errors import NafirError

if TYPE_CHECKING:
    from server.bench.capacity import Machine, Measured, Model, Sizing

_CROWDS = 1_000, 1_000_000
_TOLERANCE = 0.15
"""How far the model may be from the bench."""
_CHECK_S = 20.0
"""How long a run of the bench lasts that confirms a number of sessions, so that a check takes minutes."""
_GIB = 2**30


def plan_capacity(
    listeners: Annotated[int, typer.Option(min=1, help="How many listeners there are to be at once.")],
    emitters: Annotated[int, typer.Option(min=1, max=64, help="Emitters of each listener.")],
    scene: Annotated[
        str | None,
        typer.Option(
            help="A bundled scene's id, the folder of any scene bundle, or `bench`. [default: apartment, or that of "
            "the costs]"
        ),
    ] = None,
    costs: Annotated[
        Path | None,
        typer.Option(help="Costs measured by `nafir bench costs`, maybe on another machine. [default: measure here]"),
    ] = None,
    encoding: Annotated[str, typer.Option(help="How audio is sent: f32 or s16.")] = "f32",
    scenes: Annotated[int, typer.Option(min=1, help="Scenes that each machine serves.")] = 1,
    cores: Annotated[int | None, typer.Option(min=1, help="Cores of a machine. [default: those of this one]")] = None,
    memory_gib: Annotated[
        float | None, typer.Option(min=0.1, help="Memory of a machine. [default: that of this one]")
    ] = None,
    network_gbit: Annotated[float, typer.Option(min=0.001, help="Gbit/s of a machine's network.")] = 10.0,
    open_files: Annotated[
        int | None, typer.Option(min=1, help="Files that a process may open. [default: this system's limit]")
    ] = None,
    is_checked: Annotated[
        bool, typer.Option("--check", help="Compare with a search as in `nafir bench stream`: two to three minutes.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """How many cores and machines, how much memory and bandwidth listeners need, from measured costs.

    Also says what a thousand and a million listeners take, and which part of a machine breaks first. Measuring takes
    two minutes, on an otherwise idle machine; costs in a file need none.
    """
    from server.bench.capacity import Model, limits, size
    from server.bench.sessions import MOST_EMITTERS
    from server.protocol.codecs.registry import CODECS

    encoded = next((name for name in CODECS if name == encoding), None)
    if encoded is None:
        raise NafirError(f"--encoding: {encoding!r} is none of {', '.join(CODECS)}")
    if is_checked and emitters > MOST_EMITTERS:
        raise NafirError(f"--check: the bench has at most {MOST_EMITTERS} emitters, not {emitters}")
    measured = _measured(scene, costs)
    model = Model.of(measured)
    machine = _machine(cores, memory_gib, network_gbit, open_files)
    sizings = [
        size(model, machine, number, emitters, encoding=encoded, scenes=scenes)
        for number in dict.fromkeys((listeners, *_CROWDS))
    ]
    first = limits(model, machine, emitters, encoding=encoded, scenes=scenes)
    document: dict[str, Any] = {
        "costs": measured.model_dump(exclude={"runs"}, mode="json"),
        "machine": asdict(machine),
        "emitters": emitters,
        "one_core": {"best": model.most_at_best(emitters), "lowest": model.most(emitters)},
        "crowds": [asdict(sizing) for sizing in sizings],
        "limits": [asdict(limit) for limit in first],
        "check": _check(model, measured, emitters) if is_checked else None,
    }
    if as_json:
        print_json(document)
    else:
        _print(document, sizings)
    end_with(_off(document["check"]))


def _measured(scene: str | None, costs: Path | None) -> "Measured":
    from server.bench.costs import measure_costs, read_costs

    if costs is None:
        return measure_costs(scene or "apartment", advance=lambda step: typer.echo(step, err=True))
    measured = read_costs(costs)
    if scene is not None and scene != measured.scene:
        raise NafirError(f"--scene: the costs in {costs} are those of scene {measured.scene!r}, not of {scene!r}")
    return measured


def _machine(cores: int | None, memory_gib: float | None, network_gbit: float, open_files: int | None) -> "Machine":
    from server.api.settings import usable_cores
    from server.bench.capacity import Machine

    return Machine(
        cores or usable_cores(),
        _memory_bytes() if memory_gib is None else memory_gib * _GIB,
        network_gbit * 1e9,
        open_files or _open_files(),
    )


def _memory_bytes() -> float:
    """Raises NafirError if the system does not say."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError) as exc:
        raise NafirError("--memory-gib: this system does not say how much memory it has, so give it") from exc


def _open_files() -> int:
    if sys.platform == "win32":
        return sys.maxsize
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    return sys.maxsize if hard == resource.RLIM_INFINITY else hard


def _check(model: "Model", measured: "Measured", emitters: int) -> dict[str, Any]:
    """Compare with the largest number of sessions that the bench finds on this machine."""
    from server.bench.machine import instruction_set, processor
    from server.bench.sessions import Plan, failures, measure_sessions

    here = processor(), instruction_set()
    if (measured.processor, measured.instruction_set) != here:
        there = f"{measured.processor}, {measured.instruction_set}"
        raise NafirError(f"--check: the costs are those of {there}, and this machine is {', '.join(here)}")
    planned = model.most(emitters)
    plan = Plan(
        scenes=(measured.scene,),
        emitters=(emitters,),
        duration_s=_CHECK_S,
        poses_per_s=measured.poses_per_s,
        near=planned,
    )
    typer.echo(f"{measured.scene}: the plan has {planned} sessions on a core; the bench looks for theirs", err=True)
    found = measure_sessions(plan, lambda step: typer.echo(step, err=True))
    (case,) = found["cases"]
    return {"planned": planned, "measured": case["sessions"], "failures": failures(found["cases"])}


def _off(check: dict[str, Any] | None) -> list[str]:
    """Why the model does not agree with the bench; nothing if it does, or if it was not compared."""
    if check is None:
        return []
    planned, measured = check["planned"], check["measured"]
    if measured == 0:
        return [f"the bench found no number of sessions: {'; '.join(check['failures'])}"]
    if abs(planned - measured) > _TOLERANCE * measured:
        away = f"{planned / measured - 1:+.0%}"
        return [
            f"the plan has {planned} sessions on a core, the bench {measured}: {away}, and may be {_TOLERANCE:.0%} off"
        ]
    return []


def _print(document: dict[str, Any], sizings: "list[Sizing]") -> None:
    costs = document["costs"]
    print_measures(
        "Costs",
        {name: costs[name] for name in ("processor", "instruction_set", "date", "scene", "sample_rate", "poses_per_s")},
    )
    best, lowest = document["one_core"]["best"], document["one_core"]["lowest"]
    print_measures(
        f"Listeners of {document['emitters']} emitters on one core",
        {"at the best quality": best, "before blocks are late, at the lowest": lowest},
    )
    print_rows(
        "What crowds need",
        [
            {
                "listeners": f"{each.listeners:,}",
                "cores, best": _or_none(each.cores_best),
                "cores, lowest": _or_none(each.cores_lowest),
                "machines": _or_none(each.machines),
                "memory, GiB": each.memory_bytes / _GIB,
                **{f"{name}, Gbit/s": bits / 1e9 for name, bits in each.down_bits_per_s.items()},
                "up, Gbit/s": each.up_bits_per_s / 1e9,
            }
            for each in sizings
        ],
    )
    print_rows("What breaks first, on one machine at the best quality", document["limits"])
    if document["check"] is not None:
        print_measures("Sessions on one core", {name: document["check"][name] for name in ("planned", "measured")})


def _or_none(count: int) -> str:
    return f"{count:,}" if count else "none suffice"
