"""`photonfarm scene check` and `scene shapes`: what a spec and its scene are, and what cannot be right in them."""
