"""Tools for scenes, and for people: import, check, measure, plan view, preview, and the doctor of a machine."""
