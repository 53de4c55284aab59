"""Input and output: text, YAML, PLY and state files, paths, timestamps, downloads, archives."""
