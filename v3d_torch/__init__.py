"""V3D-SLAM in batched PyTorch tensors: RGB-D tracking and mapping in rooms where people and things move."""
