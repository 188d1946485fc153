"""The viewer in the browser: simulation, scene, panel, and the loop that runs them."""
