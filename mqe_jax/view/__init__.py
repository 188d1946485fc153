"""The browser viewer: simulation, scene, control panel, server, and main loop."""
