"""What is painted on the surfaces: layouts that are known at once, pictures that are painted when asked for."""
