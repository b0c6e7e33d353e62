"""What a stream of the package for JavaScript says and tells, in Node, without a server: listeners, clips, doors."""

import json
import shutil
import subprocess

import numpy as np
import pytest

from server.protocol.blocks import AudioBlock, DryBlock
from server.protocol.client_messages import (
    Acknowledge,
    AddEmitter,
    AddListener,
    Hello,
    ListenerPose,
    MoveEmitter,
    RemoveEmitter,
    RemoveListener,
    Resume,
    SetDoor,
    SetGain,
    SetLevel,
    StopEmitter,
    parse_client_message,
)
from tests.clients import one_shots
from tests.clients.test_javascript import HERE, MODULES, NODE
from tests.clients.test_python_wire import WELCOME

pytestmark = pytest.mark.skipif(NODE is None, reason="no node on the PATH (Debian: apt-get install nodejs)")

NEW = {**json.loads(WELCOME), "resume_token": "t1", "resume_s": 30}
SETTLED_MS = 30
"""After which a pose has been sent."""
ORIENTATION = [0.0, 0.0, 0.0, 1.0]


def block_of(number, sequence, clock):
    block = AudioBlock(sequence, clock, 0, 0, np.full((2, 128), (1 + number) / 8, np.float32), listener=number)
    return {"hex": block.serialize("f32").hex()}


def at(x):
    return {"position": [x, 1.0, 1.5], "orientation": ORIENTATION, "at": 0}


def entered(identifier, index):
    return {"type": "listener_added", "id": identifier, "index": index, "sample_clock": 0, "hrtf": "kemar"}


def refusal(code, listener, **more):
    return {"type": "error", "code": code, "message": "no", "field": None, "listener": listener, **more}


def resumed(**more):
    return {**NEW, "resumed": {"sample_clock": 0, "sequence": 0, "pose_id": 0, "handled": 0, **more}}


def run(tmp_path, *steps):
    """For each step what was sent, as the server reads it, and what was told."""
    folder = tmp_path / "modules"
    shutil.copytree(MODULES, folder)
    (folder / "package.json").write_text('{"type": "module"}')
    command = [NODE, HERE / "javascript_listeners_driver.mjs", folder]
    given = json.dumps({"steps": steps})
    done = subprocess.run(command, input=given, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    said = []
    for log in json.loads(done.stdout):
        sent = [
            parse_client_message(each["text"] if "text" in each else bytes.fromhex(each["hex"]))
            for each in log
            if each.keys() & {"text", "hex"}
        ]
        told = [each for each in log if not each.keys() & {"text", "hex"}]
        said.append((sent, told))
    return said


OPENED = [["open", None], ["receive", NEW], ["pause", SETTLED_MS]]
JOINED = [["add", {"id": "p2", **at(2)}], ["receive", entered("p2", 1)], ["pause", SETTLED_MS]]


def of(kind, said):
    return [each for each in said[0] if isinstance(each, kind)]


def test_a_listener_is_added_moved_acknowledged_and_removed(tmp_path):
    opened, joined, moved, heard, removed = run(
        tmp_path,
        OPENED,
        [["add", {"id": "p2", "head": "kemar", **at(2)}], ["receive", entered("p2", 7)], ["pause", SETTLED_MS]],
        [["move", {"id": "p2", **at(3)}], ["pause", SETTLED_MS]],
        [["receive", block_of(number, sequence, 128 * sequence)] for sequence in range(4) for number in (0, 7)],
        [["remove", "p2"], ["receive", block_of(7, 4, 512)], ["move", {"id": "p2", **at(4)}], ["pause", SETTLED_MS]],
    )
    [hello] = of(Hello, opened)
    assert hello.listeners is None
    assert of(AddListener, joined) == [
        AddListener(id="p2", hrtf="kemar", position=(2.0, 1.0, 1.5), orientation=(0.0, 0.0, 0.0, 1.0))
    ]
    assert {"joined": {"id": "p2"}} in joined[1]
    [pose] = of(ListenerPose, moved)
    assert (pose.index, pose.position) == (7, (3.0, 1.0, 1.5))
    assert {"posed": {"poseId": pose.pose_id, "listener": "p2"}} in moved[1]
    assert of(Acknowledge, heard) == [Acknowledge(sequence=3), Acknowledge(sequence=3, listener="p2")]
    blocks = [each["block"] for each in heard[1] if "block" in each]
    assert [(each["id"], each["sequence"]) for each in blocks[:3]] == [(None, 0), ("p2", 0), (None, 1)]
    assert {each["id"]: each["first"] for each in blocks} == {None: 1 / 8, "p2": 1.0}
    assert of(RemoveListener, removed) == [RemoveListener(id="p2")]
    assert of(ListenerPose, removed) == []
    assert [each for each in removed[1] if "block" in each] == []


def test_pose_ids_rise_over_all_listeners(tmp_path):
    third = [["add", {"id": "p3", **at(5)}], ["receive", entered("p3", 2)], ["pause", SETTLED_MS]]
    moves = [["move", {"id": name, **at(x)}] for x in (3, 4) for name in ("p2", "p3")]
    *_, moved = run(tmp_path, OPENED, JOINED, third, [*moves, ["pause", SETTLED_MS]])
    poses = of(ListenerPose, moved)
    assert [(each.index, each.position[0]) for each in poses] == [(1, 4.0), (2, 4.0)]
    assert poses[0].pose_id < poses[1].pose_id


def test_a_resumed_stream_has_its_listeners_and_is_sent_what_was_lost(tmp_path):
    lost = [
        ["receive", block_of(0, 9, 1_280)],
        ["receive", block_of(1, 4, 1_408)],
        ["add", {"id": "unheard", **at(3)}],
        ["add", {"id": "lost", **at(4)}],
        ["lose", 1006],
        ["reconnect", None],
        ["open", None],
    ]
    there = [{"id": "p2", "index": 1}, {"id": "unheard", "index": 2}]
    _, _, asked, gone_on, heard = run(
        tmp_path,
        OPENED,
        JOINED,
        lost,
        # It has handled two of three messages, and said of `unheard` that it is there to nobody.
        [["receive", resumed(handled=2, listeners=there)], ["pause", SETTLED_MS]],
        [["receive", block_of(1, 10, 2_560)], ["receive", block_of(2, 10, 2_560)]],
    )
    [resume] = of(Resume, asked)
    assert (resume.token, resume.sequence, resume.sample_clock) == ("t1", 9, 1_408)
    assert [each.id for each in of(AddListener, gone_on)] == ["lost"]
    assert [each["joined"]["id"] for each in gone_on[1] if "joined" in each] == ["unheard"]
    assert {each.index for each in of(ListenerPose, gone_on)} == {None, 1, 2}
    assert [each["block"]["id"] for each in heard[1]] == ["p2", "unheard"]


def test_a_new_stream_is_asked_for_its_listeners_again(tmp_path):
    forgotten = {"type": "error", "code": "unknown_resume_token", "message": "no", "field": "token"}
    *_, hello, again = run(
        tmp_path,
        OPENED,
        JOINED,
        [["lose", 1006], ["reconnect", None], ["open", None], ["receive", forgotten], ["lose", 1008], ["open", None]],
        [["receive", NEW], ["receive", entered("p2", 1)], ["pause", SETTLED_MS]],
    )
    [asked] = of(Hello, hello)
    assert asked.listeners == 2
    assert [each.id for each in of(AddListener, again)] == ["p2"]
    assert {"joined": {"id": "p2"}} in again[1]


def test_a_listener_that_is_refused_has_left_and_is_not_asked_for_again(tmp_path):
    _, _, refused, later, other = run(
        tmp_path,
        OPENED,
        JOINED,
        [["add", {"id": "p3", **at(3)}], ["receive", refusal("server_busy", "p3", retry_after_s=0.05)]],
        [["pause", 150], ["move", {"id": "p3", **at(4)}], ["pause", SETTLED_MS]],
        [["receive", refusal("position_out_of_bounds", "p2")], ["receive", block_of(1, 0, 0)]],
    )
    assert {"left": {"id": "p3", "code": "server_busy", "message": "no"}} in refused[1]
    assert {"refused": {"code": "server_busy", "listener": "p3"}} in refused[1]
    assert of(AddListener, later) == []
    assert of(ListenerPose, later) == []
    # An error about a pose of one that is there takes nobody away.
    assert [each for each in other[1] if "left" in each] == []
    assert [each["block"]["id"] for each in other[1] if "block" in each] == ["p2"]


def test_one_who_was_there_is_asked_for_again_when_a_full_server_says(tmp_path):
    forgotten = {"type": "error", "code": "unknown_resume_token", "message": "no", "field": "token"}
    *_, busy, again, gone = run(
        tmp_path,
        OPENED,
        JOINED,
        [["lose", 1006], ["reconnect", None], ["open", None], ["receive", forgotten], ["lose", 1008], ["open", None]],
        [["receive", NEW], ["receive", refusal("server_busy", "p2", retry_after_s=0.05)]],
        [["pause", 150]],
        [["receive", refusal("unknown_hrtf", "p2")]],
    )
    assert [each for each in busy[1] if "left" in each] == []
    assert [each.id for each in of(AddListener, again)] == ["p2"]
    assert {"left": {"id": "p2", "code": "unknown_hrtf", "message": "no"}} in gone[1]


LOST = [["lose", 1006], ["reconnect", None], ["open", None]]


def emitter(identifier, gain_db=0):
    return ["emitter", {"id": identifier, "live": True, "gainDb": gain_db, **at(2)}]


def radio(x, *, name="radio", clip="a", gain_db=0.0):
    return {"id": name, "clip": clip, "position": [x, 1.0, 1.5], "gainDb": gain_db, "at": 0}


def refused_emitter(name="radio", code="server_busy", **more):
    return {"type": "error", "code": code, "message": "no", "field": None, "emitter": name, **more}


def added(name="radio"):
    return {"type": "emitter_added", "id": name, "sample_clock": 0}


def test_an_emitter_that_a_full_server_refuses_is_asked_for_as_it_is_when_it_says(tmp_path):
    _, asked, moved, again, gone_on = run(
        tmp_path,
        OPENED,
        [
            ["emitter", radio(1)],
            ["emitter", radio(9, name="lamp", clip="unheard-of")],
            ["receive", refused_emitter(retry_after_s=0.5)],
            ["receive", refused_emitter("lamp", "unknown_clip")],
        ],
        [["emitter", radio(2)], ["emitter", radio(3, gain_db=-6.0)], ["pause", SETTLED_MS]],
        [["pause", 600]],
        [["receive", added()], ["emitter", radio(4, gain_db=-6.0)], ["pause", SETTLED_MS]],
    )
    assert [each.id for each in of(AddEmitter, asked)] == ["radio", "lamp"]
    assert moved[0] == []  # it would be said of one that is not there
    [once_more] = of(AddEmitter, again)
    assert (once_more.id, once_more.position[0], once_more.gain_db) == ("radio", 3.0, -6.0)
    [move] = of(MoveEmitter, gone_on)
    assert (move.id, move.position[0]) == ("radio", 4.0)


def test_an_error_about_something_else_loses_nothing_that_is_said_of_an_emitter(tmp_path):
    waiting = [["emitter", radio(1)], ["receive", refused_emitter(code="malformed_message")]]
    changed = [["emitter", radio(2)], ["emitter", radio(2, gain_db=-6.0)], ["pause", SETTLED_MS]]
    *_, heard = run(tmp_path, OPENED, waiting, changed, [["receive", added()], ["pause", SETTLED_MS]])
    assert [each.gain_db for each in of(SetGain, heard)] == [-6.0]
    assert [each.position[0] for each in of(MoveEmitter, heard)] == [2.0]


def test_a_refused_emitter_is_asked_for_again_by_a_stream_that_goes_on(tmp_path):
    refused = [["emitter", radio(1)], ["receive", refused_emitter(retry_after_s=20)]]
    lost = [["lose", 1006], ["emitter", radio(2)], ["reconnect", None], ["open", None]]
    _, _, _, gone_on = run(tmp_path, OPENED, refused, lost, [["receive", resumed(handled=1)], ["pause", SETTLED_MS]])
    [asked] = of(AddEmitter, gone_on)
    assert (asked.id, asked.position[0]) == ("radio", 2.0)


def test_a_refused_emitter_is_gone_without_a_word_once_it_is_removed_or_stopped(tmp_path):
    both = [[["emitter", radio(1, name=name)], ["receive", refused_emitter(name, retry_after_s=0.2)]] for name in "ab"]
    _, _, ended, later = run(
        tmp_path,
        OPENED,
        both[0] + both[1],
        [["removeEmitter", "a"], ["stop", {"id": "b", "fadeS": 0.01}], ["pause", SETTLED_MS]],
        [["pause", 300]],
    )
    assert ended == ([], [{"ended": {"id": "b", "removed": True}}])
    assert of(AddEmitter, later) == []


def test_listeners_at_rest_say_where_they_are_while_an_emitter_moves(tmp_path):
    steps = [step for x in range(26) for step in (["emitter", radio(1 + x / 8)], ["pause", 100])]
    heard = [["emitter", radio(1)], ["receive", added()], ["pause", SETTLED_MS]]
    *_, moving = run(tmp_path, OPENED, JOINED, heard, steps)
    indices = [each.index for each in of(ListenerPose, moving)]
    assert min(indices.count(None), indices.count(1)) >= 2


def test_of_gains_in_an_outage_the_newest_is_said_and_counted(tmp_path):
    fade = [emitter("e1", -gain / 10) for gain in range(1, 401)]
    _, _, gone_on, _, again = run(
        tmp_path,
        [*OPENED, emitter("e1")],
        [["lose", 1006], *fade, emitter("e2"), emitter("e2", -3), ["reconnect", None], ["open", None]],
        [["receive", resumed(handled=1)], ["pause", SETTLED_MS]],
        [["lose", 1006], emitter("e1", -50), ["reconnect", None], ["open", None]],
        [["receive", resumed(handled=3)], ["pause", SETTLED_MS]],
    )
    assert [(each.id, each.gain_db) for each in of(SetGain, gone_on)] == [("e1", -40), ("e2", -3)]
    assert [each.id for each in of(AddEmitter, gone_on)] == ["e2"]
    # It had handled what adds e1, the gain of e1 and what adds e2: the gain of e2 and the new one of e1 are to be said.
    assert [(each.id, each.gain_db) for each in of(SetGain, again)] == [("e2", -3), ("e1", -50)]
    assert of(AddEmitter, again) == []


def test_a_stream_of_which_too_much_is_unsaid_begins_anew(tmp_path):
    comings = [each for _ in range(600) for each in (["add", {"id": "p2", **at(2)}], ["remove", "p2"])]
    _, _, resumption, anew = run(
        tmp_path,
        OPENED,
        [["lose", 1006], emitter("e1"), *comings],
        [["reconnect", None], ["open", None], ["receive", resumed(handled=0)], ["pause", SETTLED_MS]],
        [["open", None], ["receive", NEW], ["pause", SETTLED_MS]],
    )
    assert [type(each) for each in resumption[0]] == [Resume]
    assert len(of(Hello, anew)) == 1
    assert [each.id for each in of(AddEmitter, anew)] == ["e1"]
    assert of(AddListener, anew) == []


def snapshot(text, handled):
    return {"type": "snapshot", "snapshot": text, "pose_id": 0, "handled": handled, "expires_s": 120.0}


def test_the_newest_snapshot_goes_with_the_resume_and_what_it_lacks_is_said_again(tmp_path):
    """A live emitter and a listener are not spoken of before they are there again."""
    live = {"id": "live", "live": True, "at": 0, **at(3)}
    added = {"type": "emitter_added", "id": "live", "sample_clock": 0}
    opened, _, resuming, gone_on, there = run(
        tmp_path,
        OPENED,
        [
            ["emitter", {"id": "old", "clip": "a", "at": 0, **at(2)}],
            ["receive", snapshot("older", 0)],
            ["receive", snapshot("newer", 1)],
            ["emitter", live],
            ["receive", added],
            *JOINED,
        ],
        LOST,
        [
            ["receive", resumed(handled=1, listeners=[])],
            ["feed", "live"],
            ["move", {"id": "p2", **at(5)}],
            ["pause", SETTLED_MS],
        ],
        [["receive", added], ["receive", entered("p2", 1)], ["feed", "live"], ["pause", SETTLED_MS]],
    )
    [hello] = of(Hello, opened)
    assert hello.snapshots
    [resume] = of(Resume, resuming)
    assert (resume.token, resume.snapshot) == ("t1", "newer")
    assert [each.id for each in of(AddEmitter, gone_on)] == ["live"]
    assert [each.id for each in of(AddListener, gone_on)] == ["p2"]
    assert of(DryBlock, gone_on) == []
    assert {each.index for each in of(ListenerPose, gone_on)} == {None}
    assert {"joined": {"id": "p2"}} in there[1]
    assert [each.id for each in of(DryBlock, there)] == ["live"]
    assert [(each.index, each.position[0]) for each in of(ListenerPose, there)] == [(1, 5.0)]


def test_a_snapshot_is_good_after_the_time_of_the_token_and_none_is_sent_of_another_stream(tmp_path):
    passing = {**NEW, "resume_s": 0}
    forgotten = {"type": "error", "code": "unknown_resume_token", "message": "no", "field": "snapshot"}
    _, resuming, anew = run(
        tmp_path,
        [["open", None], ["receive", passing], ["receive", snapshot("sealed", 0)]],
        [["lose", 1006], ["pause", 5], ["reconnect", None], ["open", None]],
        [["receive", forgotten], ["lose", 1008], ["open", None]],
    )
    [resume] = of(Resume, resuming)
    assert (resume.token, resume.snapshot) == (None, "sealed")
    assert len(of(Hello, anew)) == 1


def test_a_server_that_shuts_down_is_come_back_to_when_it_says(tmp_path):
    draining = {"type": "error", "code": "server_draining", "message": "on", "field": None, "retry_after_s": 1}
    _, told = run(tmp_path, OPENED, [["receive", draining], ["lose", 1012]])
    assert told[1] == [{"state": "waiting", "code": 1012, "retryMs": 1000, "isBusy": False}]


def test_a_stream_goes_on_after_many_orders_that_the_server_has(tmp_path):
    fade = [emitter("e1", -gain / 10) for gain in range(1, 401)]
    *_, gone_on = run(
        tmp_path,
        [*OPENED, emitter("e1"), *fade],
        [*LOST, ["receive", resumed(handled=400)], ["pause", SETTLED_MS]],
    )
    assert of(Hello, gone_on) == []
    assert [each.gain_db for each in of(SetGain, gone_on)] == [-40]


def test_a_listener_of_whom_nothing_is_said_is_given_up(tmp_path):
    _, _, asked, given_up, resumed_without, late = run(
        tmp_path,
        OPENED,
        JOINED,
        [["add", {"id": "p3", **at(3)}]],
        [["expire", None]],
        [*LOST, ["receive", resumed(handled=3, listeners=[{"id": "p2", "index": 1}])], ["pause", SETTLED_MS]],
        [["receive", entered("p3", 2)], ["receive", block_of(2, 0, 0)], ["expire", None]],
    )
    assert [each.id for each in of(AddListener, asked)] == ["p3"]
    assert given_up[1] == [{"left": {"id": "p3", "code": None, "message": "the listener was not there within 30 s"}}]
    assert of(RemoveListener, given_up) == [RemoveListener(id="p3")]
    assert of(AddListener, resumed_without) == []
    assert late == ([], [])


def test_an_old_server_refuses_a_listener_without_naming_it(tmp_path):
    old = {"type": "error", "code": "unknown_message", "message": "no", "field": "type"}
    other = {"type": "error", "code": "malformed_message", "message": "no", "field": "effects"}
    _, _, told, refused = run(
        tmp_path,
        OPENED,
        JOINED,
        [["add", {"id": "p3", **at(3)}], ["receive", other], ["receive", refusal("unknown_listener", "p3")]],
        [["receive", old], ["receive", block_of(1, 0, 0)]],
    )
    assert [each for each in told[1] if "left" in each] == []
    assert [each["left"]["id"] for each in refused[1] if "left" in each] == ["p3"]
    assert of(RemoveListener, refused) == [RemoveListener(id="p3")]
    assert [each["block"]["id"] for each in refused[1] if "block" in each] == ["p2"]


def clip(identifier, **more):
    return ["emitter", {"id": identifier, "clip": "bell", **at(2), **more}]


def heard(identifier, clock=0):
    return ["receive", {"type": "emitter_added", "id": identifier, "sample_clock": clock}]


def test_clips_start_and_stop_at_clocks_and_gains_ramp(tmp_path):
    times = {"startAt": 4_800.4, "stopAt": 9_600, "offsetS": 0.5, "loopStartS": 0.25, "loopEndS": 1}
    _, added, changed, live = run(
        tmp_path,
        OPENED,
        [clip("bell", **times, removeWhenEnded=True)],
        [
            clip("bell", **times, gainDb=-6, rampS=0.5),
            ["stop", {"id": "bell", "at": 7_200, "fadeS": 0.2}],
            ["stop", {"id": "nobody", "fadeS": 0.2}],
        ],
        [["emitter", {"id": "microphone", "live": True, "jitterMs": 40, **at(2)}]],
    )
    [bell] = of(AddEmitter, added)
    assert (bell.start_at, bell.stop_at, bell.offset_s, bell.loop_start_s, bell.loop_end_s, bell.remove_when_ended) == (
        4_800,
        9_600,
        0.5,
        0.25,
        1,
        True,
    )
    assert of(SetGain, changed) == [SetGain(id="bell", gain_db=-6, ramp_s=0.5)]
    assert of(StopEmitter, changed) == [StopEmitter(id="bell", stop_at=7_200, fade_s=0.2)]
    assert [each.jitter_ms for each in of(AddEmitter, live)] == [40]


def ended(identifier, removed):
    return {"type": "emitter_ended", "id": identifier, "sample_clock": 0, "removed": removed}


def test_the_end_of_a_clip_is_told_and_one_that_is_removed_is_not_moved_any_more(tmp_path):
    _, told, moved = run(
        tmp_path,
        OPENED,
        [
            *[clip(name, loop=False) for name in ("bell", "horn")],
            *[["receive", ended(name, name == "bell")] for name in ("bell", "horn")],
        ],
        [["removeEmitter", "bell"], ["removeEmitter", "horn"]],
    )
    assert [each["ended"] for each in told[1] if "ended" in each] == [
        {"id": "bell", "removed": True},
        {"id": "horn", "removed": False},
    ]
    assert of(RemoveEmitter, moved) == [RemoveEmitter(id="horn")]


def test_what_was_heard_to_its_end_since_the_snapshot_is_not_played_again(tmp_path):
    *_, gone_on, again = run(
        tmp_path,
        OPENED,
        [
            ["receive", snapshot("sealed", 0)],
            *[clip("shot", loop=False, removeWhenEnded=True), clip("loop")],
            ["receive", ended("shot", True)],
            *LOST,
        ],
        [["receive", resumed(handled=0)], ["level", "auto"], ["pause", SETTLED_MS]],
        # The server counts what it got: two messages, of which it has handled one.
        [*LOST, ["receive", resumed(handled=1)], ["pause", SETTLED_MS]],
    )
    assert [each.id for each in of(AddEmitter, gone_on)] == ["loop"]
    assert of(AddEmitter, again) == []
    assert of(SetLevel, again) == [SetLevel(level="auto")]


def shots(said):
    """As tests/clients/one_shots.py has it, with `removed` for an emitter that is gone though its end was told."""
    sent, told = said
    words = [f"{each.type}:{each.id}" for each in sent if isinstance(each, AddEmitter | RemoveEmitter | SetGain)]
    ends = [each["ended"] for each in told if "ended" in each]
    return sorted([*words, *(f"{'removed' if each['removed'] else 'ended'}:{each['id']}" for each in ends)])


def test_clips_that_play_once_and_were_heard_are_not_played_again_when_their_server_is_lost(tmp_path):
    forgotten = {"type": "error", "code": "unknown_resume_token", "message": "no", "field": "token"}
    _, *steps = run(
        tmp_path,
        OPENED,
        [
            *[clip("loop"), clip("again", loop=False), heard("loop")],
            ["receive", snapshot("sealed", 2)],
            *[clip(name, loop=False) for name in ("over", "stays", "heard", "waiting")],
            clip("later", loop=False, startAt=1_000_000),
            *[heard(name) for name in ("again", "over", "stays", "heard")],
            heard("later", 1_000_000),
            clip("heard", loop=False, gainDb=-3),
            *[["receive", ended("over", True)], ["receive", ended("stays", False)]],
            ["receive", block_of(0, 0, 0)],
        ],
        [*LOST, ["receive", resumed(handled=2)], ["pause", SETTLED_MS]],
        [heard("again", 5_120)],
        [["receive", ended(name, True)] for name in ("again", "over", "heard")],
        [*LOST, ["receive", resumed(handled=4)], ["pause", SETTLED_MS]],
        [
            *[heard("waiting", 6_000), ["receive", block_of(0, 48, 6_144)], ["lose", 1006], ["reconnect", None]],
            *[["open", None], ["receive", forgotten], ["lose", 1008], ["open", None], ["receive", NEW]],
        ],
    )
    wanted = [step.split() for step in one_shots.STEPS]
    begun, gone_on, again, told_again, by_the_number, anew = map(shots, steps)
    assert begun == sorted([*set(wanted[0]) - {"ended:over"}, "removed:over"])
    assert gone_on == ["add_emitter:later", "add_emitter:waiting", "removed:heard", "removed:stays"]
    assert again == ["remove_emitter:again", "removed:again"]
    assert told_again == wanted[3]
    assert by_the_number == wanted[4]
    assert anew == ["add_emitter:later", "add_emitter:loop", "removed:waiting"]


def test_what_is_said_in_an_outage_of_a_clip_that_is_over_is_not_sent(tmp_path):
    *_, gone_on = run(
        tmp_path,
        OPENED,
        [
            ["receive", snapshot("sealed", 0)],
            *[clip("shot", loop=False), heard("shot"), ["receive", block_of(0, 0, 0)]],
            *[["lose", 1006], clip("shot", loop=False, gainDb=-3), ["level", "auto"]],
            *[["reconnect", None], ["open", None]],
        ],
        [["receive", resumed(handled=0)], ["pause", SETTLED_MS]],
    )
    assert [type(each) for each in gone_on[0]] == [SetLevel, ListenerPose]


def test_a_clip_whose_id_is_given_again_in_an_outage_is_played(tmp_path):
    *_, gone_on = run(
        tmp_path,
        OPENED,
        [
            ["receive", snapshot("sealed", 0)],
            *[clip("shot", loop=False), heard("shot"), ["receive", block_of(0, 0, 0)]],
            *[["lose", 1006], ["removeEmitter", "shot"], clip("shot", loop=False), ["reconnect", None], ["open", None]],
        ],
        [["receive", resumed(handled=0)], ["pause", SETTLED_MS]],
    )
    assert [type(each) for each in gone_on[0]][:3] == [AddEmitter, RemoveEmitter, AddEmitter]
    assert [each for each in gone_on[1] if "ended" in each] == []


def test_a_new_stream_goes_on_with_the_clock_and_begins_no_clip_again_that_plays_once(tmp_path):
    forgotten = {"type": "error", "code": "unknown_resume_token", "message": "no", "field": "token"}
    begun = [*[heard(name) for name in ("loop", "once", "stopped")], heard("waiting", 48_000)]
    _, _, anew, there = run(
        tmp_path,
        OPENED,
        [
            *[clip("loop"), clip("once", loop=False), clip("stopped"), clip("waiting", loop=False, startAt=48_000)],
            *begun,
            ["stop", {"id": "stopped", "fadeS": 0.1}],
            *[["receive", block_of(0, sequence, 128 * sequence)] for sequence in range(17)],
        ],
        [*LOST, ["receive", forgotten], ["lose", 1008], ["open", None]],
        [["receive", NEW], ["receive", block_of(0, 0, 0)], ["pause", SETTLED_MS]],
    )
    assert [each["ended"]["id"] for each in anew[1] if "ended" in each] == ["once", "stopped"]
    [loop, waiting] = of(AddEmitter, there)
    [clock] = [each["clock"] for each in there[1] if "clock" in each]
    assert (loop.id, waiting.id) == ("loop", "waiting")
    # 17 blocks of 128 were heard, and blocks of the new stream come after that, by the server's own clock from 0 on.
    assert clock >= 18 * 128
    assert waiting.start_at == 48_000 - (clock - 128)


WITH_DOORS = {**NEW, "doors": {"kitchen": 0.0}}


def test_what_changes_while_a_hello_is_not_answered_is_said_after_its_welcome(tmp_path):
    before = [["door", {"name": "kitchen", "openness": 0.25}], ["level", "standard"], ["open", None]]
    while_waiting = [["door", {"name": "kitchen", "openness": share}] for share in (0.5, 0.75)] + [["level", "draft"]]
    opened, waiting, welcomed = run(tmp_path, before, while_waiting, [["receive", WITH_DOORS], ["pause", SETTLED_MS]])
    [hello] = of(Hello, opened)
    assert (hello.doors, hello.level) == ({"kitchen": 0.25}, "standard")
    assert waiting[0] == []
    assert of(SetDoor, welcomed) == [SetDoor(door="kitchen", openness=0.75)]
    assert of(SetLevel, welcomed) == [SetLevel(level="draft")]


def test_a_door_that_the_scene_does_not_have_is_not_asked_for_again(tmp_path):
    forgotten = {"type": "error", "code": "unknown_resume_token", "message": "no", "field": "token"}
    doors = [["door", {"name": name, "openness": 1.0}] for name in ("kitchen", "of another scene")]
    _, asked, again = run(
        tmp_path,
        [["open", None], ["receive", WITH_DOORS]],
        doors,
        [*LOST, ["receive", forgotten], ["lose", 1008], ["open", None]],
    )
    assert [each.door for each in of(SetDoor, asked)] == ["kitchen", "of another scene"]
    [hello] = of(Hello, again)
    assert hello.doors == {"kitchen": 1.0}
