"""The scene: its spec, its configurations, its views and its point cloud."""
