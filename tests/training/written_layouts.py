"""Small datasets in the layouts of others, each with decaying responses, and predictions for them."""

import json
import zlib
from pathlib import Path

import numpy as np
import soundfile

RATE = 16_000
SAMPLES = 4_000
POINTS = {0: (0.0, 0.0, 1.5), 1: (3.0, 0.0, 1.5), 3: (0.5, 2.5, 1.5), 4: (2.5, 2.0, 1.5)}
AZIMUTHS = (0, 90)
MICROPHONES = np.array([[0.05 * x, 0.05 * y, 0.0] for x in range(4) for y in range(3)])
LOUDSPEAKERS = np.array([[2.0, 1.0, 0.0], [-1.5, 2.0, 0.4]])


def response(name: str, channels: int, *, reverberation_s: float = 0.2) -> np.ndarray:
    """(channel, sample): a direct sound, and noise that decays; another for each name."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    time_s = np.arange(SAMPLES) / RATE
    heard = 0.1 * rng.standard_normal((channels, SAMPLES)) * 10 ** (-3 * time_s / reverberation_s)
    arrival = int(rng.integers(20, 60))
    heard[:, :arrival] = 0.0
    heard[:, arrival] = 0.8
    return heard.astype(np.float32)


def wav(path: Path, samples: np.ndarray, rate: int = RATE) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    soundfile.write(path, samples.T, rate, subtype="FLOAT")
    return path


def soundspaces(folder: Path) -> Path:
    lines = [f"{index}\t{x}\t{y}\t{z}" for index, (x, y, z) in POINTS.items()]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "points.txt").write_text("\n".join(lines) + "\n")
    names = [f"{a}/{r}_{s}" for a in AZIMUTHS for r in POINTS for s in POINTS if r != s]
    for name in names:
        wav(folder / f"{name}.wav", response(name, 2))
    (folder / "split.json").write_text(json.dumps({"train": names[4:], "test": names[:4]}))
    return folder


def raf(folder: Path) -> Path:
    names = [f"{number:06d}" for number in range(10)]
    for number, name in enumerate(names):
        wav(folder / "data" / name / "rir.wav", response(name, 1))
        (folder / "data" / name / "rx_pos.txt").write_text(f"{0.1 * number},1.2,{0.3 * (number % 3)}\n")
        # The loudspeaker turns, which a benchmark must not mind.
        turn = np.pi * (number % 2) / 4
        (folder / "data" / name / "tx_pos.txt").write_text(f"0,{np.sin(turn)},0,{np.cos(turn)},3,1.5,1\n")
    split = {"train": [names[:6]], "validation": names[6:7], "test": [names[7:]]}
    (folder / "data-split_emptyroom.json").write_text(json.dumps(split))
    return folder


def meshrir(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "pos_mic.npy", MICROPHONES)
    np.save(folder / "pos_src.npy", LOUDSPEAKERS)
    for index in range(len(MICROPHONES)):
        rows = [response(f"{index}_{source}", 1)[0] for source in range(len(LOUDSPEAKERS))]
        np.save(folder / f"ir_{index}.npy", np.stack(rows).astype(np.float64))
    return folder


def acousticrooms(folder: Path) -> Path:
    for room in ("Cafe/Cafe_idx_1", "Office/Office_idx_3"):
        for source in range(2):
            for receiver in range(3):
                name = f"{room}/S{source:03d}_R{receiver:03d}"
                wav(folder / "single_channel_ir" / f"{name}_hybrid_IR.wav", response(name, 1))
                told = folder / "metadata" / room / f"S00{source}_R00{receiver}.json"
                told.parent.mkdir(parents=True, exist_ok=True)
                told.write_text(json.dumps({"src_loc": [3.0, source, 1.5], "rec_loc": [0.0, receiver, 1.5]}))
    return folder


WRITTEN = {"soundspaces": soundspaces, "raf": raf, "meshrir": meshrir, "acousticrooms": acousticrooms}
CHANNELS = {"soundspaces": 2, "raf": 1, "meshrir": 1, "acousticrooms": 1}
