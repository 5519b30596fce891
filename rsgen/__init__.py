"""rsgen: rolling-shutter RGB-D benchmark sequences with exact continuous-time ground truth."""
