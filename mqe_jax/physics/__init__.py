"""Robots, objects, scenes and the engines that simulate them."""
