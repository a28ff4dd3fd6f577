"""What results are worth: evaluation against photos, fog, LPIPS, coverage and visibility."""
