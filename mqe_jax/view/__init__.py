"""The browser viewer: simulation, scene, control panel, and main loop."""
