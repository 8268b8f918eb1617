"""`photonfarm scene import`: a scene of other programs read, written for Mitsuba 3, and a spec proposed for it."""
