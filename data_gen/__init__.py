"""Path-traced targets: the judge. Shares no light transport with what it judges; imports neither torch nor Warp."""
