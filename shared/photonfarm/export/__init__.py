"""Samples of a store in formats that other programs read: `photonfarm export`.

Nothing here needs Mitsuba or torch; some formats need packages of the extra `export`.
"""
