"""The scoreboard: what the project claims, measured by one command, compared with the last time, and shown.

python -m benchmarks gate --against benchmarks/results/gate.json
"""
