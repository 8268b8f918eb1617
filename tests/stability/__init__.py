"""Is the integrator `bdpt` right where bidirectional path tracers go wrong? Hard scenes, their truths, and a report.

`scenes` holds hard scenes with their truths; `rows` lists them by number; `runner` renders one and judges it; `report`
runs them all and shows the results. `invariances` are what must not change an image, `weights` an oracle for the
integrator's weights. The tests here render the quick version; `make stability` renders the long one and writes its
page. All of it needs Mitsuba's variant set (`photonfarm.renderer.scene.backend.load`) before it is imported.
"""
