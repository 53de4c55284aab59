"""ORB features: detection, descriptor matching, projection matching, RANSAC."""
