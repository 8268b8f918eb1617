"""Writing: plans, a job's rows and its commit, and what is set aside."""
