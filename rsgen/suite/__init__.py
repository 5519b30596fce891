"""Benchmark suites: versioned lists of sequences, rendered whole, with a manifest, checked, and described by a card."""
