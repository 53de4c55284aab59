"""Occupancy map: free and occupied space for planning, with floor, distance field and files."""
