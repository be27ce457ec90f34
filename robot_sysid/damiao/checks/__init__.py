"""What has to hold before an arm may move: of the file, the motors, the bus and the model."""
