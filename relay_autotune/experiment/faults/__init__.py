"""What ends an experiment: faults of the sensor, the process, the actuator, the clock."""
