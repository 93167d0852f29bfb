"""The detector: frames in, tracks and features out (paper, "Classification")."""

from __future__ import annotations

import numpy as np

from catstream.box import Box
from catstream.detection import affine, bootstrap, windows
from catstream.detection.hog import WINDOW, row_length
from catstream.detection.windows import Scored
from catstream.messages import Features, Model, Track
from catstream.settings import Settings

__all__ = ["Detector"]

_CELLS = 20


class Detector:
    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.seq = 0
        self.box: Box | None = None
        self.model = None
        self.rng = np.random.default_rng(settings.seed)
        self.centre_cell = (_CELLS - WINDOW) // 2
        self.score = 1.0
        self.state = 'bootstrapping'
        self.velocity = np.zeros(2)

    def init(self, image, box, time=0.0):
        height, width = image.shape[:2]
        self.box = self.first = Box(*box).inside(width, height)
        self.size = (width, height)
        s = self.settings
        copies = affine.copies(image, self.box, s.coreset_size, self.rng)
        rows, labels, weights = self._surroundings(image, None)
        rows = np.vstack([copies, rows[1:]])
        labels = np.concatenate([np.ones(len(copies), np.float32), labels[1:]])
        weights = np.concatenate([np.full(len(copies), s.object_weight, np.float32), weights[1:]])
        # far background of first frame
        self.model = bootstrap.stand_in(rows, labels, s)
        far = self._mine(image, s.first_negatives)
        if len(far):
            rows = np.vstack([rows, far]); labels = np.concatenate([labels, np.zeros(len(far), np.float32)]); weights = np.concatenate([weights, np.ones(len(far), np.float32)])
        self.model = bootstrap.stand_in(rows, labels, s)
        self.seq = 1
        return self._answer(0, time, rows, labels, weights)

    def _answer(self, frame, time, rows, labels, weights):
        box = self.box if self.state != 'absent' else None
        track = Track(self.seq, frame, time, self.state, box, float(self.score), self.model.version)
        return track, Features(self.seq, frame, time, box, rows, labels, weights)

    def adopt(self, model: Model) -> None:
        if model.version > self.model.version:
            self.model = model

    def step(self, image, time=0.0):
        s = self.settings
        self.seq += 1
        frame = self.seq - 1
        score, box = self._local(image)
        if score < s.sure_score and (score < s.lost_score or frame % s.global_frames == 0):
            g_score, g_box = self._global(image)
            if g_score > score + (s.jump_margin if score > s.lost_score else 0):
                # refine
                b2, sc2 = self.box, self.score
                self.box = g_box
                score2, box2 = self._local(image)
                if score2 > score: 
                    score, box = score2, box2
                else: self.box = b2
        self.score = score
        if score >= s.present_score:
            self.state = 'present' if self.model.version else 'bootstrapping'
            self.box = box
        else:
            self.state = 'absent'
        none = np.empty((0, row_length()), np.float32), np.empty(0, np.float32), np.empty(0, np.float32)
        if score < s.teach_score:
            return self._answer(frame, time, *none)
        rows, labels, weights = self._surroundings(image, frame)
        if frame % s.mine_frames == 0 and score > s.mine_score:
            far = self._mine(image, s.mine_count)
            if len(far):
                rows = np.vstack([rows, far]); labels = np.concatenate([labels, np.zeros(len(far), np.float32)]); weights = np.concatenate([weights, np.ones(len(far), np.float32)])
        return self._answer(frame, time, rows, labels, weights)

    def _local(self, image):
        s = self.settings
        best = (-9, None, None)
        for scale in s_scales(s):
            scored = self._scored(windows.around(image, self.box.scaled(scale), _CELLS))
            n = scored.scores.shape[0]
            off = (np.arange(n) - self.centre_cell) * scale
            dist = (off[:, None] ** 2 + off[None] ** 2) / WINDOW**2
            adj = scored.scores - s.distance_penalty * dist - s.scale_penalty * abs(np.log(scale)) / 0.03
            i = int(adj.argmax()); r, c = divmod(i, n)
            if adj[r, c] > best[0]:
                best = (adj[r, c], scored, (r, c), scale)
        _, scored, (r, c), scale = best
        fr, fc = scored.refined(r, c)
        box = scored.box(fr, fc)
        # damp the scale
        damp = scale ** (s.scale_rate - 1)
        box = box.scaled(damp)
        x, y = box.centre
        x = min(max(x, 0), self.size[0] - 1); y = min(max(y, 0), self.size[1] - 1)
        return float(scored.scores[r, c]), box.centred(x, y)

    def _scored(self, around):
        cells, origin, step = around
        return Scored(cells, windows.respond(cells, self.model.weights, self.model.bias), origin, step)

    def _global(self, image):
        s = self.settings
        best = (-9, None)
        for scale in (0.8, 1.0, 1.25):
            box = self.box.scaled(scale)
            if box.w * box.h < 100: continue
            scored = self._scored(windows.whole(image, box))
            r, c = divmod(int(scored.scores.argmax()), scored.scores.shape[1])
            if scored.scores[r, c] > best[0]:
                best = (float(scored.scores[r, c]), scored.box(*scored.refined(r, c)))
        return best

    def _mine(self, image, count):
        scored = self._scored(windows.whole(image, self.box))
        found = windows.peaks(scored.scores, count + 1, 4)
        rows = [scored.row(*p) for p in found if scored.box(*p).overlap(self.box) < 0.2]
        return np.array(rows[:count], np.float32)

    def _surroundings(self, image, frame):
        s = self.settings
        cells, origin, step = windows.around(image, self.box, _CELLS)
        k = self.centre_cell
        n = _CELLS - WINDOW + 1
        at = [(k, k)]
        near = self.rng.integers(-2, 3, size=(s.near_misses, 2))
        at += [(k + a, k + b) for a, b in near if a or b]
        labels = [1.0] + [float(np.exp(-(a * a + b * b) / (2 * s.near_sigma**2))) for a, b in near if a or b]
        weights = [s.object_weight] + [1.0] * (len(at) - 1)
        neg = []
        if self.model is not None:
            scores = windows.respond(cells, self.model.weights, self.model.bias)
            scores[k - 2 : k + 3, k - 2 : k + 3] = -np.inf
            neg = windows.peaks(scores, s.negatives // 2, 2, -1e9)
        while len(neg) < s.negatives:
            p = tuple(self.rng.integers(0, n, 2))
            if max(abs(p[0] - k), abs(p[1] - k)) > 2:
                neg.append(p)
        at += neg
        labels += [0.0] * len(neg)
        weights += [1.0] * len(neg)
        rows = np.array([cells[r : r + WINDOW, c : c + WINDOW].reshape(-1) for r, c in at], np.float32)
        return rows, np.array(labels, np.float32), np.array(weights, np.float32)


def s_scales(s):
    return [1 + s.scale_step * k for k in (0, -2, -1, 1, 2)]
