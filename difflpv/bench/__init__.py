"""Speed against accuracy: every method on the same receivers, its error, its time and its memory."""
