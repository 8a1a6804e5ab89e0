"""Room: mapping."""
