"""Jobs: what a render job computes, and the buffers along a camera path."""
