"""What a user would pick instead, over the same link, with the same load and the same clock."""
