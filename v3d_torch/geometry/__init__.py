"""Camera model, rigid motions and depth images as tensors."""
