"""The paper's experiments over our rooms; run.py runs them, and tables.py puts their reports together."""
