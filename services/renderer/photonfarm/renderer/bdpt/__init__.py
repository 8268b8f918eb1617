"""The integrator plugin ``bdpt`` for Mitsuba 3: unbiased bidirectional path tracing.

Importing this package *after* ``mitsuba.set_variant`` registers the plugin, for ``mi.load_dict({"type": "bdpt", …})``
and XML alike. `photonfarm.renderer.load_mitsuba` does both, and chooses an LLVM that works::

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    import photonfarm.renderer.bdpt
    integrator = mi.load_dict({"type": "bdpt", "connections": 1, "light_ratio": 1.0})
    image = mi.render(scene, integrator=integrator, seed=7, spp=16)

Raises RuntimeError if no variant is set, ValueError for scalar, spectral and polarised ones. ``mi.render`` wraps
errors raised while rendering (a ValueError that says what is refused) in a RuntimeError;
``integrator.render(scene, …)`` raises them as they are.
"""

from photonfarm.renderer.bdpt.scenes import require_variant

require_variant()

from photonfarm.renderer.bdpt.integrator import BidirectionalPathTracer  # noqa: E402
from photonfarm.renderer.bdpt.photons import TracedPhotons, trace_photons  # noqa: E402

__all__ = ["BidirectionalPathTracer", "TracedPhotons", "trace_photons"]
