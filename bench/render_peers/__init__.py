"""What `bench/render.py` is made of: peers, their measurement, and the page about them."""
