"""Targets that stay in the memory of the device that trains: it makes its batches itself, and need not wait for the
processor.

Axes: values are (row, ear, *axes, outputs), as `Naf` has them.
"""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from server.acoustics.codec import Codec

_MOST = 0.5
_ROWS_AT_A_TIME = 512


class HeldTargets:
    """Rows of aligned responses, or of expected values, on a device. `axes` are the sizes of the field's axes,
    `outputs` is the number of its values at a point."""

    def __init__(
        self,
        flat: npt.NDArray[np.float16],
        codec: Codec,
        channels: int,
        axes: tuple[int, ...],
        outputs: int,
        *,
        encoded: bool,
        device: torch.device,
    ) -> None:
        self._shape, self._codec, self._encoded = (channels, *axes, outputs), codec, encoded
        self._flat = torch.empty(flat.shape, dtype=torch.float16, device=device)
        for start in range(0, len(flat), _ROWS_AT_A_TIME):
            some = np.array(flat[start : start + _ROWS_AT_A_TIME])
            self._flat[start : start + len(some)] = torch.from_numpy(some).to(device)
        self._window = torch.from_numpy(codec.window).float().to(device)
        self._advance = torch.from_numpy(codec.nominal_advance).float().to(device)

    @staticmethod
    def fit(flat: npt.NDArray[np.float16], device: torch.device) -> bool:
        """Whether the device is a GPU, with twice as much free memory as they take."""
        return device.type == "cuda" and flat.nbytes <= _MOST * torch.cuda.mem_get_info(device)[0]

    @property
    def device(self) -> torch.device:
        return self._flat.device

    def at(self, rows: npt.NDArray[np.int64], indices: Tensor) -> Tensor:
        """(B, ear, N, outputs) values of rows (B,) at points, which are given by their indices (axis, B, N)."""
        values = self._values(torch.from_numpy(rows).to(self.device))
        which = torch.arange(len(rows), device=self.device)[:, None]
        return values[which, :, *indices].movedim(2, 1)

    def _values(self, rows: Tensor) -> Tensor:
        flat = self._flat[rows].float()
        channels, *axes, outputs = self._shape
        if self._encoded or outputs == 1:
            return flat.reshape(len(rows), channels, *axes, outputs)
        return self._encode(flat.reshape(len(rows), channels, -1))

    def _encode(self, signal: Tensor) -> Tensor:
        """(..., sample) to log-magnitude and instantaneous frequency (..., frequency, frame, 2), as by `Codec.encode`,
        in single precision."""
        codec = self._codec
        lead, size = codec.frame_lead_samples, (codec.frames - 1) * codec.hop + codec.n_fft
        padded = torch.nn.functional.pad(signal, (lead, max(0, size - lead - signal.shape[-1])))[..., :size]
        spectrogram = torch.fft.rfft(padded.unfold(-1, codec.n_fft, codec.hop) * self._window).transpose(-1, -2)
        phase = spectrogram.angle()
        advance = torch.remainder(phase.diff(dim=-1) - self._advance + torch.pi, 2 * torch.pi) - torch.pi
        log_magnitude = torch.log(spectrogram.abs() + codec.log_floor)
        return torch.stack([log_magnitude, torch.cat([phase[..., :1], advance], dim=-1)], dim=-1)
