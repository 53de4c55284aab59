"""The map: keyframes, landmarks, bundle adjustment, the pose of every frame."""
