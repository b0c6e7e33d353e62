import hashlib
import json
import pickle

import pytest

from training.data.splits import UNKNOWN_SOURCE, SplitError, hashed_split, read_split, split_of_groups

NAMES = [f"{heading}/{receiver}_{source}" for heading in (0, 90) for receiver in range(4) for source in range(4)]


def plain(name):
    return name.removesuffix(".wav")


@pytest.fixture
def written(tmp_path):
    def write(content, name="split.json"):
        path = tmp_path / name
        path.write_bytes(pickle.dumps(content) if name.endswith(".pkl") else json.dumps(content).encode())
        return path

    return write


def test_lists_by_role_are_read(written):
    split = read_split(written({"train": NAMES[:9], "validation": NAMES[9:11], "test": NAMES[11:14]}), NAMES, plain)
    assert (split.train, split.test, split.validation) == tuple(map(frozenset, (NAMES[:9], NAMES[11:14], NAMES[9:11])))
    assert [split.role(NAMES[number]) for number in (0, 9, 11, 20)] == ["train", "validation", "test", ""]


def test_lists_may_be_nested_as_those_of_raf(written):
    split = read_split(written({"train": [NAMES[:3]], "validation": NAMES[3:4], "test": [NAMES[4:6]]}), NAMES, plain)
    assert (len(split.train), len(split.validation), len(split.test)) == (3, 1, 2)


def test_lists_by_heading_are_read_as_those_of_naf(written):
    train, test = {"0": ["0_1", "0_2"], "90": ["1_2"]}, {"0": ["2_3.wav"], "90": []}
    split = read_split(written([train, test], "scene_complete.pkl"), NAMES, plain)
    assert split.train == {"0/0_1", "0/0_2", "90/1_2"}
    assert split.test == {"0/2_3"}


@pytest.mark.parametrize("content", [["0/1_2.wav", "90/3_3.wav"], {"0": ["1_2"], "90": ["3_3"]}])
def test_a_list_of_test_responses_leaves_the_others_for_training(written, content):
    split = read_split(written(content), NAMES, plain)
    assert split.test == {"0/1_2", "90/3_3"}
    assert split.train == set(NAMES) - split.test


class _Touches:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_a_pickle_runs_no_code(written, tmp_path):
    canary = tmp_path / "ran"
    path = written([_Touches(canary)], "split.pkl")
    with pytest.raises(SplitError, match="which is not read"):
        read_split(path, NAMES, plain)
    assert not canary.exists()


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"train": NAMES, "test": []}, "names no test response"),
        ({"train": NAMES[:5], "test": NAMES[4:6]}, f"1 responses both to learn from and to test on: {NAMES[4]}"),
        ({"train": NAMES[:5], "test": ["0/7_7", "../../etc/passwd"]}, "names 2 of 2 test responses that"),
        (NAMES, "leaves no response to learn from"),
        ({"train": NAMES, "test": [3]}, "has int where names of responses should be"),
    ],
)
def test_a_split_that_does_not_fit_is_refused(written, content, problem):
    with pytest.raises(SplitError, match=problem):
        read_split(written(content), NAMES, plain)


@pytest.mark.parametrize("damaged", [b"", b"{", b"\x80\x05K"])
@pytest.mark.parametrize("name", ["split.json", "split.pkl"])
def test_a_damaged_file_is_refused_by_its_name(tmp_path, damaged, name):
    (tmp_path / name).write_bytes(damaged)
    with pytest.raises(SplitError, match=name):
        read_split(tmp_path / name, NAMES, plain)
    with pytest.raises(SplitError, match="cannot be read"):
        read_split(tmp_path / "none.json", NAMES, plain)


def test_the_hashed_split_is_as_it_says():
    pairs = {name: name.split("/")[1] for name in NAMES}
    split = hashed_split(pairs, 0.3)
    by_hand = {
        name for name, pair in pairs.items() if int(hashlib.sha256(pair.encode()).hexdigest()[:8], 16) / 16**8 < 0.3
    }
    assert split.test == by_hand
    assert split.train == set(NAMES) - by_hand
    # All headings of a pair are on one side, and other responses change nothing.
    assert {pairs[name] for name in split.test}.isdisjoint({pairs[name] for name in split.train})
    fewer = hashed_split({name: pairs[name] for name in NAMES[:20]}, 0.3)
    assert fewer.test == by_hand & set(NAMES[:20])


def test_a_hashed_split_of_few_pairs_tests_one_of_them():
    split = hashed_split({"a": "1", "b": "1", "c": "2"}, 1e-9)
    assert split.test in ({"a", "b"}, {"c"})
    with pytest.raises(SplitError, match="one pair only"):
        hashed_split({"a": "1", "b": "1"})


def test_the_digest_is_that_of_both_parts():
    groups = {name: name.split("/")[0] for name in NAMES}
    split = split_of_groups(groups, {"90"}, name="turned", source="here")
    lines = [*sorted(split.test), "", *sorted(split.train)]
    assert split.digest == hashlib.sha256("\n".join(lines).encode()).hexdigest()
    assert split.digest != split_of_groups(groups, {"0"}, name="turned", source="here").digest
    with pytest.raises(SplitError, match="none of its 1 test groups"):
        split_of_groups(groups, {"45"}, name="turned", source="here")


def test_a_published_split_is_known_by_the_names_of_its_test_responses(written, monkeypatch):
    path = written({"train": NAMES[:5], "test": NAMES[5:8]})
    assert read_split(path, NAMES, plain).source == UNKNOWN_SOURCE
    digest = hashlib.sha256("\n".join(sorted(NAMES[5:8])).encode()).hexdigest()
    monkeypatch.setattr("training.data.splits.PUBLISHED", {digest: "a paper"})
    assert read_split(path, NAMES, plain).source == "a paper"
    assert read_split(written({"train": NAMES[:5], "test": NAMES[5:9]}), NAMES, plain).source == UNKNOWN_SOURCE
