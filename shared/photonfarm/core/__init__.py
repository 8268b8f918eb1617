"""What everything rests on: errors, keys, arrays, files and processes; it knows nothing of scenes."""
