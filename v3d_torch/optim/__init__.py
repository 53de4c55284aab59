"""Least-squares solvers and the reprojection errors that they minimise."""
