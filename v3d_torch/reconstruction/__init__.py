"""Dense reconstruction of the static scene: point map and triangle mesh."""
