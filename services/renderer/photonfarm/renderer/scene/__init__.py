"""A scene in Mitsuba: loaded once, edited in place, and seen as buffers."""
