"""What is controlled, and by what: the process, the control task, controllers, and both in closed loop."""
