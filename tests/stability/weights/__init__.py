"""The weights of multiple importance sampling against an independent oracle in float64."""
