//! A plan: any bytes are refused, or are the one encoding of a motion that is finite everywhere.

#![no_main]

use libfuzzer_sys::fuzz_target;
use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::wire::codec;
use telemime_protocol::wire::v1::MAX_PLAN_LEN;

fuzz_target!(|bytes: &[u8]| {
    let Ok(plan) = codec::decode::<PosePlan, MAX_PLAN_LEN>(bytes) else {
        return;
    };
    assert_eq!(codec::encode(&plan), bytes);
    let Ok(curve) = plan.curve() else {
        return;
    };
    for i in 0..=16 {
        let t = curve.end_s() * f64::from(i) / 16.0;
        let x = curve.position_at(t);
        assert!(x.iter().all(|v| v.is_finite()), "{x:?} at {t}");
        if let Some(q) = curve.orientation_at(t) {
            assert!((q.norm() - 1.0).abs() < 1e-6);
        }
        if let Some(grip) = curve.grip_at(t) {
            assert!((0.0..=1.0).contains(&grip));
        }
    }
});
