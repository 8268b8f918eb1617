"""The formats: how samples become a file, and what describes all files of a folder."""
