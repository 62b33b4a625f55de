"""What moves the specimen: links, the virtual rig, commissioning, identification."""
