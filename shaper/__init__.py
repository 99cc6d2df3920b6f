"""What leaves when: queues, pacing and the link between the robot and the operator."""
