"""What `bench.renderer.render` is made of: peers, their measurement, and the page about them."""
