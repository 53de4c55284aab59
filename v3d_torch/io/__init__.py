"""Files on disk and on the web: text, PLY, YAML, archives, downloads, timestamps."""
