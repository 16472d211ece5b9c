//! How far apart to speak, so that nothing queues: slower while a queue builds up, faster again once it is gone.

/// A delay this much above the least seen lately is a queue, s.
const QUEUE_S: f64 = 0.1;

/// The least delay is that of this span and the one before, s: a path may become longer, and the session clock moves by up to
/// 5 ms/s.
const SPAN_S: f64 = 5.0;

/// One step slower …
const SLOWER: f64 = 2.0;

/// … and one faster, so often, s.
const FASTER: f64 = 0.8;
const FASTER_S: f64 = 0.25;

/// The interval between messages of one flow, by the delay that they are seen to take.
///
/// Additive increase and multiplicative decrease would be for many flows that share a link fairly; this one has to be out
/// of its own way. Doubling the interval halves the rate, at most once for every round trip; two seconds without a
/// queue bring a fourfold rate back.
#[derive(Debug, Clone, Copy)]
pub struct Pacer {
    least_s: f64,
    most_s: f64,
    interval_s: f64,
    floor_s: [f64; 2],
    span_from_s: f64,
    /// No change before.
    next_s: f64,
}

impl Pacer {
    /// Intervals from `least_s`, where it begins, to `most_s`.
    pub fn new(least_s: f64, most_s: f64) -> Self {
        Self {
            least_s,
            most_s: most_s.max(least_s),
            interval_s: least_s,
            floor_s: [f64::INFINITY; 2],
            span_from_s: f64::NEG_INFINITY,
            next_s: f64::NEG_INFINITY,
        }
    }

    /// At `now_s` it became known that a message of this flow took `delay_s`; `choked` says that too many do not arrive
    /// at all. Both on any clock, as long as it is the same.
    pub fn observe(&mut self, now_s: f64, delay_s: f64, choked: bool) {
        if !delay_s.is_finite() {
            return;
        }
        if now_s - self.span_from_s > SPAN_S {
            self.floor_s = [f64::INFINITY, self.floor_s[0]];
            self.span_from_s = now_s;
        }
        self.floor_s[0] = self.floor_s[0].min(delay_s);
        let queue_s = delay_s - self.floor_s[0].min(self.floor_s[1]);
        if now_s < self.next_s {
            return;
        }
        if choked || queue_s > QUEUE_S {
            self.interval_s = (self.interval_s * SLOWER).min(self.most_s);
            // What is under way was said before it was known.
            self.next_s = now_s + FASTER_S + queue_s;
        } else if self.interval_s > self.least_s && queue_s < QUEUE_S / 2.0 {
            self.interval_s = (self.interval_s * FASTER).max(self.least_s);
            self.next_s = now_s + FASTER_S;
        }
    }

    /// How far apart to speak, s.
    pub fn interval_s(&self) -> f64 {
        self.interval_s
    }

    /// How starved the flow is: 0 if it may speak as it likes, 1 if as rarely as it ever does.
    pub fn starved(&self) -> f64 {
        let span_s = self.most_s - self.least_s;
        if span_s > 0.0 {
            (self.interval_s - self.least_s) / span_s
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_queue_slows_it_down_and_its_end_brings_it_back() {
        let mut pacer = Pacer::new(0.01, 0.2);
        for i in 0..20 {
            pacer.observe(0.1 * f64::from(i), 0.05, false);
        }
        assert_eq!((pacer.interval_s(), pacer.starved()), (0.01, 0.0));
        for i in 20..80 {
            pacer.observe(0.1 * f64::from(i), 0.4, false);
        }
        assert_eq!((pacer.interval_s(), pacer.starved()), (0.2, 1.0));
        for i in 80..130 {
            pacer.observe(0.1 * f64::from(i), 0.06, false);
        }
        assert_eq!(pacer.interval_s(), 0.01);
    }

    #[test]
    fn loss_alone_slows_it_down_and_a_longer_path_does_not_for_ever() {
        let mut pacer = Pacer::new(0.01, 0.2);
        pacer.observe(0.0, 0.05, false);
        pacer.observe(0.5, 0.05, true);
        assert_eq!(pacer.interval_s(), 0.02);
        // A path that has become longer looks like a queue until the short one is forgotten.
        for i in 0..600 {
            pacer.observe(1.0 + 0.1 * f64::from(i), 0.3, false);
        }
        assert_eq!(pacer.interval_s(), 0.01);
        pacer.observe(100.0, f64::NAN, true);
        assert_eq!(pacer.interval_s(), 0.01);
    }
}
