"""What is measured: quality, size, speed, and pictures to look at."""
