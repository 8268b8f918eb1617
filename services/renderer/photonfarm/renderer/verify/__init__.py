"""Is the integrator `bdpt` right where bidirectional path tracers go wrong? Hard scenes, their truths, and a report.

`case` defines hard scenes; `closed_form`, `lights`, `surfaces` and `cameras` hold them; `rows` lists them by number;
`runner` renders one and judges it; `report` runs them all; `markdown` and `pictures` show the results. All but
`case` need Mitsuba's variant set (`photonfarm.renderer.scene.backend.load`) before they are imported.
"""
