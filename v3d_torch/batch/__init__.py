"""Many runs on one machine or on a Ray cluster, and the studies made of them."""
