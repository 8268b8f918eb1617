"""The render service: workers that turn plan slots into committed samples."""
