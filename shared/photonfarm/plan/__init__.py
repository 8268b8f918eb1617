"""The plan: which samples of a scene are to be rendered, which are held out, and what they cost."""
