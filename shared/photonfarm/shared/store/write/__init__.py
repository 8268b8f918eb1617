"""Writing: plans, a job's rows and its commit, guides, and what is set aside."""
