//! Lines of a tracker: any bytes are refused for a reason, or are a frame within what a frame may be; in one go and line by line.

#![no_main]

use libfuzzer_sys::fuzz_target;
use telemime_operator::demonstration::Sample;
use telemime_operator::ingest::{LengthUnit, TimeUnit};
use telemime_operator::input::frame::{self, Frame, Units};
use telemime_operator::input::{What, read};
use telemime_protocol::time::Stamp;

fn judge(frame: &Frame) {
    assert!(frame.t_s.is_none_or(f64::is_finite));
    assert!(frame.hand.is_some() || frame.engage.is_some());
    if let Some(hand) = &frame.hand {
        assert!(hand.position.iter().all(|v| v.abs() <= 100.0));
        assert!(
            hand.orientation
                .is_none_or(|q| (q.norm() - 1.0).abs() < 1e-9)
        );
        assert!(hand.grip.is_none_or(|g| (0.0..=1.0).contains(&g)));
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((&kind, bytes)) = data.split_first() else {
        return;
    };
    let units = Units {
        length: if kind & 1 == 0 {
            LengthUnit::M
        } else {
            LengthUnit::Mm
        },
        time: if kind & 2 == 0 {
            TimeUnit::S
        } else {
            TimeUnit::Ms
        },
        grip: if kind & 4 == 0 {
            (0.0, 1.0)
        } else {
            (90.0, 10.0)
        },
        ..Units::default()
    };
    if let Ok(frame) = frame::parse(bytes, &units) {
        judge(&frame);
        // What was understood can be said, and means the same.
        if let (Some(t_s), Some(hand)) = (frame.t_s, frame.hand) {
            let sample = Sample {
                t_s,
                position: hand.position,
                orientation: hand.orientation,
                grip: hand.grip,
            };
            let again = frame::line(&sample, frame.engage);
            let again = frame::parse(again.as_bytes(), &Units::default()).expect("our own line");
            assert_eq!(again.engage, frame.engage);
            let place = again.hand.expect("it has a place");
            // JSON's digits are read to the last bit or the one before.
            let apart = (place.position - hand.position).norm();
            assert!(apart < 1e-12 && place.grip.is_some() == hand.grip.is_some());
        }
    }
    // The clock stands still, so that fewer frames pass than there is room for.
    let (outlet, mut inlet) = read::channel(Box::new(|| Stamp(0)));
    read::lines(bytes, &units, outlet);
    let mut ended = false;
    while let Ok(arrived) = inlet.arrived.try_recv() {
        assert!(!ended, "nothing comes after the end");
        match arrived.what {
            What::Frame(frame) => judge(&frame),
            What::Dropped(_) => {}
            What::End(_) => ended = true,
        }
    }
    assert!(ended);
});
