"""ORB features: detection, matching, projection search, RANSAC."""
