"""The farm: submitting work, running all of its processes, and predicting its cost."""
