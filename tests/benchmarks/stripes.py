"""Synthetic frames with one stripe, their exact truth, and the bound that no estimator beats."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """A sampled Gaussian stripe: amplitude and noise in DN, width (standard deviation) in px."""

    amplitude_dn: float = 180.0
    width_px: float = 2.0
    noise_dn: float = 2.0
    background_dn: float = 20.0
    impulses: float = 0.0
    step_px: float = 0.0
    clip_dn: float = 254.0

    def frame(
        self, seed: int, width: int = 640, height: int = 480
    ) -> tuple[npt.NDArray[np.uint8], Floats]:
        """(frame, true centre of each row): a slowly bending stripe, or two straight ones at a step."""
        rng = np.random.default_rng(seed)
        row = np.arange(height)
        phase = rng.uniform(0, 6)
        u = width / 2 + 0.12 * width * np.sin(row / 90 + phase) + rng.uniform(-0.5, 0.5)
        if self.step_px:
            u = width / 2 + 0.1 * row + np.where(row >= height // 2, self.step_px, 0.0) + rng.uniform()
        profile = np.exp(-0.5 * ((np.arange(width) - u[:, None]) / self.width_px) ** 2)
        noisy = self.background_dn + self.amplitude_dn * profile
        noisy += rng.normal(0, self.noise_dn, profile.shape)
        frame = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        if self.impulses:
            struck = rng.random(frame.shape) < self.impulses
            frame[struck] = rng.integers(0, 2, int(struck.sum())) * 255
        return frame, u

    def bound_px(self, u: Floats) -> Floats:
        """Cramer-Rao bound of each row's centre, from the samples that are not clipped.

        sigma^2 = (s^2 + 1/12) / sum (df/du)^2: for all samples 1.062 sqrt(w) s / A.
        """
        x = np.arange(int(u.max() + 12 * self.width_px) + 2)
        t = (x - u[:, None]) / self.width_px
        profile = self.amplitude_dn * np.exp(-0.5 * t**2)
        seen = self.background_dn + profile < self.clip_dn
        slope = np.where(seen, profile * t / self.width_px, 0.0)
        return np.sqrt((self.noise_dn**2 + 1 / 12) / (slope**2).sum(axis=1))


CASES = {
    "nominal": Case(),
    "dim": Case(amplitude_dn=60.0),
    "w = 1": Case(width_px=1.0),
    "w = 5": Case(width_px=5.0),
    "bright background": Case(amplitude_dn=120.0, background_dn=110.0),
    "saturated": Case(amplitude_dn=600.0),
    "1 % impulses": Case(impulses=0.01),
}
STEP = {
    "step": Case(step_px=30.0),
    "step, dim": Case(step_px=30.0, amplitude_dn=60.0),
    "step, 0.1 % salt": Case(step_px=30.0, impulses=0.001),
    "0.1 % salt": Case(impulses=0.001),
}


def empty(case: Case, seed: int) -> npt.NDArray[np.uint8]:
    """The same frame without its stripe."""
    return replace(case, amplitude_dn=0.0, step_px=0.0).frame(seed)[0]
