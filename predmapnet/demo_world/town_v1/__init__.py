"""Towns of the first version of the world, frozen: kept so that new networks can be measured on the old towns."""
