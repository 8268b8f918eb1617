"""`photonfarm web`: pages on which a farm is watched while it works. They only read, and fetch nothing from elsewhere.

A server of Python's own library gives three files (a page, its style, its script), small JSON documents, pictures and
points; the script draws. So there is no build step and no package to install.
"""
