from catstream.compression.compressor import Compressor
from catstream.detection.detector import Detector
from catstream.settings import Settings
from catstream.training.trainer import Trainer


class Tracker:
    def __init__(self, settings=None):
        self.settings = settings or Settings()
        self.detector = Detector(self.settings)
        self.compressor = Compressor(self.settings)
        self.trainer = Trainer(self.settings)

    def init(self, frame, box):
        self._learn(self.detector.init(frame, box))

    def update(self, frame):
        self._learn(self.detector.step(frame))
        return self.track.box is not None, self.track.box

    def _learn(self, result):
        self.track, features = result
        sample = self.compressor.take(features)
        if sample is not None:
            self.detector.adopt(self.trainer.train(sample))
