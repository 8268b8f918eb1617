"""What a spec should say of a scene: its room, what may move in it and where, its lights and its views."""
