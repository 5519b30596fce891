"""From a config to a sequence folder: frames, writer, identity, distribution over processes."""
