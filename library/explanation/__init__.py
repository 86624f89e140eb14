"""Why a frame was segmented as it was: the recursion, split by split."""
