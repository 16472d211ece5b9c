//! How often the record of a stop is written: whoever drives must not be able to fill a disk by stopping.

use telemime_endpoint::Mono;

use super::recorder::Due;

/// Two records of stops are this far apart at least, s: what lies between is in the later one, which goes back for minutes.
const APART_S: f64 = 10.0;

/// So many stops of a process are recorded, and the last.
pub(super) const MOST: u32 = 64;

/// What is to be done for a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Share {
    /// It is to be written.
    Write(Due),
    /// It is the first that is not: there were enough.
    Enough(Due),
}

/// Which stops are written, and when.
#[derive(Debug, Default)]
pub(super) struct Ration {
    waiting: Option<Due>,
    written: u32,
    newest: Option<Mono>,
    said: bool,
}

impl Ration {
    /// The record shows a stop: it waits, in the place of one that waits already.
    pub(super) fn note(&mut self, due: Due) {
        self.waiting = Some(due);
    }

    /// What is to be done at `now`; the `last` stop of a process is written whatever came before it.
    pub(super) fn take(&mut self, now: Mono, last: bool) -> Option<Share> {
        let due = self.waiting?;
        if !last && self.written >= MOST {
            self.waiting = None;
            let first = !std::mem::replace(&mut self.said, true);
            return first.then_some(Share::Enough(due));
        }
        let soon = |newest| now.secs_since(newest) < APART_S;
        if !last && self.newest.is_some_and(soon) {
            return None;
        }
        (self.waiting, self.newest) = (None, Some(now));
        self.written += 1;
        Some(Share::Write(due))
    }

    /// So many that were to be written could not be.
    pub(super) fn give_back(&mut self, unwritten: u32) {
        self.written = self.written.saturating_sub(unwritten);
    }
}

#[cfg(test)]
mod tests {
    use telemime_protocol::wire::v1::Cause;

    use super::*;

    #[test]
    fn stops_without_end_make_so_many_records_so_far_apart_and_the_last() {
        let (mut ration, mut written, mut enough) = (Ration::default(), Vec::new(), 0);
        let at = |tenths: i64| Mono(1_000_000_000 + tenths * 100_000_000);
        // A stop every two seconds for an hour, looked at ten times a second.
        for tenths in 0..36_000 {
            if tenths % 20 == 0 {
                ration.note(Due::Stop(Cause::OperatorStop));
            }
            match ration.take(at(tenths), false) {
                Some(Share::Write(_)) => written.push(tenths),
                Some(Share::Enough(_)) => enough += 1,
                None => {}
            }
        }
        assert_eq!((written.len() as u32, enough), (MOST, 1), "said once");
        assert_eq!(written[0], 0, "the first at once");
        assert!(written.windows(2).all(|pair| pair[1] - pair[0] == 100));
        let fault = Due::Stop(Cause::ArmFault);
        ration.note(fault);
        assert_eq!(ration.take(at(36_000), true), Some(Share::Write(fault)));
        assert_eq!(ration.take(at(36_001), true), None);
    }

    #[test]
    fn what_could_not_be_written_uses_up_nothing() {
        let mut ration = Ration::default();
        let (stop, mut s) = (Due::Stop(Cause::OperatorStop), 0);
        let mut take = |ration: &mut Ration| {
            s += 10;
            ration.note(stop);
            ration.take(Mono(s * 1_000_000_000), false)
        };
        for _ in 0..2 * MOST {
            assert_eq!(take(&mut ration), Some(Share::Write(stop)));
            ration.give_back(1);
        }
        for _ in 0..MOST {
            assert_eq!(take(&mut ration), Some(Share::Write(stop)));
        }
        assert_eq!(take(&mut ration), Some(Share::Enough(stop)));
    }

    #[test]
    fn a_stop_soon_after_another_waits_and_is_not_forgotten() {
        let mut ration = Ration::default();
        let at = |s: i64| Mono(s * 1_000_000_000);
        let [lapse, stop] = [Cause::LeaseExpired, Cause::OperatorStop].map(Due::Stop);
        ration.note(lapse);
        assert_eq!(ration.take(at(100), false), Some(Share::Write(lapse)));
        ration.note(lapse);
        ration.note(stop);
        assert_eq!(ration.take(at(109), false), None);
        assert_eq!(ration.take(at(110), false), Some(Share::Write(stop)));
        assert_eq!(ration.take(at(200), false), None);
    }
}
