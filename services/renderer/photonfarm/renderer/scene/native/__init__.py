"""What the Python modules of Mitsuba and Dr.Jit cannot set, set in their libraries through ctypes."""
