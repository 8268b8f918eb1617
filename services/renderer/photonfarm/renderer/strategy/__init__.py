"""The choice of a scene's sampling: which techniques of `bdpt`, how many light paths, which photons.

Every choice is unbiased, since `bdpt` has the same mean for all its settings; a choice decides the noise per second.
"""
