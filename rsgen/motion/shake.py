"""Hand-shake: band-limited Gaussian noise whose power spectrum falls as a power of the frequency."""

from __future__ import annotations

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError


def band_noise(
    rng: np.random.Generator, count: int, rate_hz: float, band_hz: tuple[float, float], exponent: float
) -> FloatArray:
    """(count, 6) samples at `rate_hz` of six independent signals, each with an RMS of exactly one and a mean of zero.

    Their power spectral density is f^-exponent within band_hz = (low, high) and zero outside; Fourier coefficients are
    independent complex Gaussians (Shinozuka & Deodatis, "Simulation of stochastic processes by spectral
    representation", Appl. Mech. Rev. 44(4), 1991, with random amplitudes). The signals have the period count / rate_hz.

    A model, not a fit to recordings: exponent 2 makes the velocity white (a random walk held in place), larger
    exponents put the motion into slow sway and leave less for what is above 3 Hz. The hand's tremor proper, of about
    8 to 12 Hz, is faster than a spline with 50 ms knots can follow: see `rsgen.motion.tremor`.
    Raises UserError if the band holds no frequency.
    """
    frequencies = np.fft.rfftfreq(count, 1.0 / rate_hz)
    inside = (frequencies >= band_hz[0]) & (frequencies <= band_hz[1])
    if not inside.any():
        step = rate_hz / count
        raise UserError(
            f"motion: shake_band_hz {list(band_hz)} holds no multiple of 1/duration = {step:.3g} Hz: widen it"
        )
    spectrum = np.zeros((6, len(frequencies)), np.complex128)
    gaussian = rng.normal(size=(6, int(inside.sum()), 2))
    spectrum[:, inside] = (gaussian[..., 0] + 1j * gaussian[..., 1]) * frequencies[inside] ** (-exponent / 2)
    signal = np.fft.irfft(spectrum, n=count).T
    return np.asarray(signal / np.sqrt(np.mean(signal**2, axis=0)))
