"""Images of a trained network for samples of a store and for camera paths.

This package alone stands above renderer and trainer: it may use both in one process, with both extras installed.
"""
