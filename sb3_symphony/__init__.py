"""Stable-Baselines3 plugin: Symphony, REDQ and DroQ."""
