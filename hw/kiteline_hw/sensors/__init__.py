"""Raw images and samples enter (encoded, unpaired, unchecked); Frames, ImuBatches and OdometryBatches leave."""
