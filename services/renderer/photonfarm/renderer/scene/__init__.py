"""Scenes in Mitsuba: loaded once, edited in place, and rendered as buffers."""
