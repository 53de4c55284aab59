"""One run and its files: request, log, checkpoints, results."""
