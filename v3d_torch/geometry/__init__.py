"""Camera model, rigid motions, depth images and point clouds as tensors."""
