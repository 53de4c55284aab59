"""Least-squares solvers and reprojection residuals."""
