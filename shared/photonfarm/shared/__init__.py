"""What every service of photonfarm agrees on: specs, sampling, keys, plans, and the store."""
