"""Is the integrator `bdpt` right where bidirectional path tracers go wrong? Hard scenes, their truths, and a report.

`case` says what a hard scene is; `closed_form`, `lights`, `surfaces` and `cameras` hold them; `rows` lists them by
number; `runner` renders one and judges; `report` runs them all; `markdown` and `pictures` show what was found. All but
`case` need Mitsuba's variant set (`photonfarm.renderer.scene.backend.load`) before they are imported.
"""
