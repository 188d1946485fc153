"""Recording, cameras, rendering, clips and learning curves."""
