"""A small simulated room: renders what a turning laser scanner would see, with known truth."""
