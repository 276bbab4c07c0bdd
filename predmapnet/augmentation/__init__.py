"""Changes to the frames of a training that keep their truth exact: photography, mirroring, lost and wrong cameras."""
