"""The map: keyframes, landmarks, local bundle adjustment, culling and map files."""
