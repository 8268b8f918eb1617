"""The requirements on Mitsuba's variant, checked on import."""

from __future__ import annotations

import mitsuba as mi


def require_variant() -> str:
    """The active variant's name; raises RuntimeError if none is set, ValueError for one the integrator cannot use."""
    variant = mi.variant()
    if variant is None:
        raise RuntimeError(
            "photonfarm.renderer.bdpt: no Mitsuba variant is set, and its types are bound on import; "
            "call mitsuba.set_variant('llvm_ad_rgb') before importing this package"
        )
    unsupported = [word for word in ("scalar", "spectral", "polarized") if word in variant]
    if unsupported:
        raise ValueError(
            f"photonfarm.renderer.bdpt: variant {variant!r} is {unsupported[0]}; the integrator needs a vectorised, "
            "unpolarised RGB variant, because its loops are traced by Dr.Jit and its light paths carry neither "
            "wavelengths nor Mueller matrices; use 'llvm_ad_rgb' or 'cuda_ad_rgb'"
        )
    return str(variant)
