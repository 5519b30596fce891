"""What images are aligned to: keyframes, how they are made, rectified, fused, stored."""
