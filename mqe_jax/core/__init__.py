"""What every other module builds on: errors, limits, settings, files, signals, devices, types."""
