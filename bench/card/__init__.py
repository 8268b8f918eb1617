"""What a machine's device gives and takes: values, times, rates, steps, and errors at equal time."""
