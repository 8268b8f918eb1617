"""Which light to choose: a table of probabilities over a coarse grid of the scene, made from the lights as they are.

In each cell a light is chosen in proportion to the irradiance it would cast there without occluders, estimated from a
few samples of the light seen from points of the cell; a share stays with the lights' own sampling weights, since
occluders are not known. The table is data: it is made on the device at the start of each render, and any
positive probabilities leave the estimate unbiased (cf. Shirley, Wang and Zimmerman, *Monte Carlo Techniques for Direct
Lighting Calculations*, 1996, who choose by an unshadowed estimate at each point).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt import randomness
from photonfarm.renderer.bdpt.guiding.grid import Grid

CELLS = 8  # of the grid, along each axis
_SAMPLES = 4  # of each light in each cell
_DEFENSIVE = 0.2  # share of the probability that follows the sampling weights
_GRID_KEY = 0x5E1EC7
_FLAT = 1e-4  # largest 1 − |cos| between a vertex normal and its face's normal at which a mesh light counts as flat
_PROBES = ((1 / 3, 1 / 3, 1 / 3), (0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8))
"""The points of each face that are looked up, in barycentric coordinates."""


LightIndex: TypeAlias = "mi.Int32 | mi.UInt32"
"""Numbers of lights; ``dr.binary_search`` finds signed ones."""


@dataclass(slots=True)
class Selection:
    """Probabilities of N lights in C = CELLS³ cells."""

    count: int  # N
    grid: Grid
    cdf: mi.Float  # [C·N]: running sums, cell after cell
    pmf: mi.Float  # [C·N]
    slot: mi.UInt32  # by Dr.Jit's registry id of the emitter: its number among the N
    overall: mi.Float  # [N]: mean of pmf over the cells

    def choose(self, p: mi.Point3f, u: mi.Float) -> tuple[mi.Int32, mi.Float]:
        """(number of a light, its probability) at points ``p``, by inversion of the running sum at ``u`` in [0, 1)."""
        first = self.grid.cell(p) * self.count
        target = u * dr.gather(mi.Float, self.cdf, first + (self.count - 1))
        last = self.count - 1
        light = dr.binary_search(0, last, lambda i: dr.gather(mi.Float, self.cdf, first + i) <= target)
        return light, dr.gather(mi.Float, self.pmf, first + light)

    def probability(self, p: mi.Point3f, emitter: mi.EmitterPtr) -> mi.Float:
        """The probability of choosing ``emitter`` at points ``p``; 0 for the null pointer."""
        number = dr.reinterpret_array(mi.UInt32, emitter)
        slot = dr.gather(mi.UInt32, self.slot, number)
        return dr.gather(mi.Float, self.pmf, self.grid.cell(p) * self.count + slot, number != 0)


def read_selection(pointers: mi.EmitterPtr, ids: list[int], base: mi.Float, box: mi.ScalarBoundingBox3f) -> Selection:
    """The table for N ≥ 2 lights ``pointers`` with registry ids ``ids`` and sampling weights ``base`` [N].

    ``box`` is the scene's bounding box. Lights with weight 0 are never chosen.
    """
    n, cells = len(ids), CELLS**3
    grid = Grid.over(box, CELLS)
    pair = dr.arange(mi.UInt32, cells * n * _SAMPLES) // _SAMPLES
    cell, light = pair // n, pair % n
    rng = randomness.sampler(
        randomness.stream(mi.UInt32(_GRID_KEY), 0, pair), dr.arange(mi.UInt32, cells * n * _SAMPLES) % _SAMPLES
    )
    corner = mi.Point3f(cell % CELLS, cell // CELLS % CELLS, cell // (CELLS * CELLS))
    xy = rng.next_2d()
    seen_from = dr.zeros(mi.Interaction3f)
    seen_from.p = grid.lower + grid.size * (corner + mi.Vector3f(xy.x, xy.y, rng.next_1d()))
    alive = dr.gather(mi.Float, base, light) > 0
    emitter = dr.gather(mi.EmitterPtr, pointers, light)
    cast = dr.max(emitter.sample_direction(seen_from, rng.next_2d(), alive)[1])
    cast = dr.block_sum(dr.select(alive & dr.isfinite(cast) & (cast > 0), cast, 0), _SAMPLES)

    light = dr.arange(mi.UInt32, cells * n) % n
    weight = dr.gather(mi.Float, base, light)
    own, total = weight / _over_cell(weight, n), _over_cell(cast, n)
    pmf = dr.select(total > 0, (1 - _DEFENSIVE) * cast / total + _DEFENSIVE * own, own)
    pmf = dr.select(weight > 0, pmf, 0)
    cdf = dr.block_prefix_sum(pmf, n, exclusive=False)
    overall = dr.zeros(mi.Float, n)
    dr.scatter_add(overall, pmf / cells, light)
    slot = dr.zeros(mi.UInt32, max(ids) + 1)
    dr.scatter(slot, dr.arange(mi.UInt32, n), mi.UInt32(ids))
    dr.eval(cdf, pmf, slot, overall)
    return Selection(n, grid, cdf, pmf, slot, overall)


def _over_cell(value: mi.Float, n: int) -> mi.Float:
    """The sum over a cell's n entries, at each of them [C·n]."""
    return dr.repeat(dr.block_sum(value, n), n)


def sampling_weight(emitter: mi.Emitter, parameters: mi.SceneParameters) -> mi.Float:
    """The weight of a light's selection [1]: the emitter's ``sampling_weight`` while it shines, else 0."""
    brightness = brightness_of(parameters)
    shines = mi.Bool(not brightness)
    for key in brightness:
        shines |= _is_positive(parameters[key])
    if "scale" in parameters:
        shines &= _is_positive(parameters["scale"])
    return dr.select(shines, dr.opaque(mi.Float, emitter.sampling_weight()), 0)


def brightness_of(parameters: mi.SceneParameters) -> list[str]:
    """The names of the parameters of a light that scale its brightness."""
    kinds = ("radiance.", "intensity.", "irradiance.")
    return [key for key in parameters.keys() if key.startswith(kinds) and not key.endswith("to_uv")]  # noqa: SIM118


def _is_positive(value: Any) -> mi.Bool:
    """Whether a parameter, of whatever type, is or holds a number above 0, as data [1]."""
    if isinstance(value, bool | str):
        return mi.Bool(False)
    if isinstance(value, int | float):
        return dr.opaque(mi.Float, float(value)) > 0
    if dr.is_tensor_v(value):
        return dr.max(value.array) > 0
    if not (dr.is_array_v(value) and dr.is_float_v(value)):
        return mi.Bool(False)
    dr.make_opaque(value)
    highest = dr.max(value) if dr.depth_v(value) > 1 else value
    return dr.max(highest) > 0 if dr.width(highest) > 1 else highest > 0


def is_flat(mesh: mi.Mesh) -> mi.Bool:
    """Whether a mesh light's vertex normals are its faces' normals, as data [1].

    Otherwise Mitsuba converts densities with the wrong cosine, which also biases `path`. Such lights get selection
    probability 0, and only hits find them.
    """
    if mesh.class_name() == "Rectangle" or not mesh.has_vertex_normals():
        return mi.Bool(True)
    corner = dr.arange(mi.UInt32, mesh.face_count()) * 3
    faces = mesh.faces_buffer()
    vertices = [dr.gather(mi.UInt32, faces, corner + k) for k in range(3)]
    p0, p1, p2 = (dr.gather(mi.Point3f, mesh.vertex_positions_buffer(), v) for v in vertices)
    normal = dr.normalize(dr.cross(p1 - p0, p2 - p0))
    normals = mesh.vertex_normals_buffer()
    aligned = [dr.abs(dr.dot(normal, dr.gather(mi.Vector3f, normals, v))) for v in vertices]
    return dr.max(dr.fmax(1 - dr.minimum(dr.minimum(aligned[0], aligned[1]), aligned[2]), 0)) < _FLAT


def is_unfolded(mesh: mi.Mesh) -> mi.Bool:
    """Whether texture coordinates in [0, 1]² say where on a mesh light a point lies, as data [1].

    Mitsuba chooses points of a textured light by its texels. Where several faces share a texel, or texels repeat, it
    finds only one of the faces, which also biases `path`. Such lights get selection probability 0, and only hits find
    them. Four points of each face are looked up; faces that overlap elsewhere alone are not noticed.
    """
    if mesh.class_name() == "Rectangle":
        return mi.Bool(True)
    if not mesh.has_vertex_texcoords():
        return mi.Bool(False)
    lane = dr.arange(mi.UInt32, mesh.face_count() * len(_PROBES))
    probe = lane % len(_PROBES)
    share = [dr.gather(mi.Float, mi.Float([weights[k] for weights in _PROBES]), probe) for k in range(3)]
    vertices = [dr.gather(mi.UInt32, mesh.faces_buffer(), lane // len(_PROBES) * 3 + k) for k in range(3)]
    uv = mi.Point2f(0)
    for weight, vertex in zip(share, vertices, strict=True):
        uv += weight * dr.gather(mi.Point2f, mesh.vertex_texcoords_buffer(), vertex)
    hit = mesh.eval_parameterization(uv)
    itself = hit.is_valid() & (hit.prim_index == lane // len(_PROBES)) & dr.all((uv >= 0) & (uv <= 1))
    return dr.max(dr.select(itself, 0, 1)) < 1
