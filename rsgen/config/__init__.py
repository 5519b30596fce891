"""The configuration of a sequence, section by section, validated."""
