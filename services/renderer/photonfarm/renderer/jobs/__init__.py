"""Jobs: rendering a job's samples, and the buffers along a camera path."""
