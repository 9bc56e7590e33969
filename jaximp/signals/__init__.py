"""Filters without a shift in time, derivatives, and what raw samples are like: noise, jumps, steps."""
