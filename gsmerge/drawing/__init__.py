"""Pictures for people: renders, previews, camera paths, clips, and pages for a browser."""
