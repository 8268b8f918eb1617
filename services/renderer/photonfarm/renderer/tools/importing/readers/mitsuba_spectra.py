"""Colours of Mitsuba scenes, in each way of writing them, as linear sRGB."""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.tools.importing import elements, images

Colour = NDArray[np.float64]
"""Linear sRGB, (3,)."""


def read_old(node: Element) -> Colour | None:
    """The colour of an element of Mitsuba 0.6, None for what is none; raises ValueError for numbers that are none.

    `rgb` is linear also in hexadecimal digits, and `srgb` is not. Spectra and black bodies are integrated against the
    CIE's curves without a white point, as 0.6's RGB mode does.
    """
    text = node.get("value", "").strip()
    if node.tag == "blackbody":
        scale = float(node.get("scale") or node.get("multiplier") or 1)
        return _blackbody(float(node.get("temperature", "").strip().rstrip("Kk"))) * scale
    if node.tag == "spectrum" and node.get("filename"):
        import mitsuba as mi

        return _integrate(*mi.spectrum_from_file(node.get("filename", "")))
    if node.tag == "spectrum" and ":" in text:
        samples = numbers_of(text.replace(":", " "))
        return _integrate(samples[::2], samples[1::2])
    if node.tag not in ("rgb", "srgb", "xyz", "spectrum"):
        return None
    digits = re.fullmatch("#([0-9a-fA-F]{6})", text)
    numbers = [byte / 255 for byte in bytes.fromhex(digits[1])] if digits else numbers_of(text)
    if len(numbers) not in (1, 3):
        raise ValueError(f"{text!r} has {len(numbers)} numbers, and a colour has one or three")
    values = np.broadcast_to(np.array(numbers), 3)
    if node.tag == "xyz":
        return images.RGB_OF_XYZ @ values
    return images.linear(values.astype(np.float32)).astype(np.float64) if node.tag == "srgb" else values


def read_new(texture: Element, *, shines: bool) -> Colour | None:
    """The colour of a texture that Mitsuba 3 evaluates in its spectral modes alone, None for others."""
    values = {part.get("name", ""): part.get("value", "") for part in texture}
    kind = texture.get("type")
    if kind == "blackbody":
        return _blackbody(float(values.get("temperature", "5000"))) * float(values.get("scale", "1"))
    if kind not in ("regular", "irregular") or "values" not in values:
        return None
    samples = numbers_of(values["values"])
    ends = float(values.get("wavelength_min", "360")), float(values.get("wavelength_max", "830"))
    at = np.linspace(*ends, len(samples)).tolist() if kind == "regular" else numbers_of(values.get("wavelengths", ""))
    if len(at) != len(samples):
        raise ValueError(f"it has {len(samples)} values and {len(at)} wavelengths")
    return _integrate(at, samples, reflects=not shines)


def put(node: Element, colour: Colour) -> None:
    """Let an element be a colour, of the same name."""
    node.tag, node[:] = "rgb", []
    node.attrib = {"name": node.get("name", ""), "value": elements.numbers(colour.tolist())}


def numbers_of(text: str) -> list[float]:
    """Numbers with spaces or commas between; raises ValueError for what is none, or is not finite."""
    numbers = [float(each) for each in re.findall(r"[^\s,]+", text)]
    if not np.isfinite(numbers).all():
        raise ValueError(f"{text!r} is no number")
    return numbers


def _blackbody(kelvin: float) -> Colour:
    """Planck's radiance in W / (m² sr nm), as a colour."""
    wavelengths = np.linspace(360.0, 830.0, 95)
    metres = wavelengths * 1e-9
    radiance = 1.191042972e-25 / metres**5 / np.expm1(0.01438776877 / (metres * kelvin))
    return _integrate(wavelengths.tolist(), radiance.tolist())


def _integrate(wavelengths: list[float], values: list[float], *, reflects: bool = False) -> Colour:
    """The colour of light; of what reflects, as Mitsuba 3 has it: under daylight, and within 0 and 1."""
    import mitsuba as mi

    return np.array(mi.spectrum_list_to_srgb(wavelengths, values, reflects, reflects), np.float64).clip(0)
