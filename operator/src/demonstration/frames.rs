//! Where objects were: comment lines `# frame NAME x y z [qw qx qy qz]` of a recording.

use std::path::Path;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use telemime_protocol::skill::{MAX_NAME_BYTES, Placement};

use super::{DemonstrationError, NORM_SLACK, usable};

/// The frames a file states, in its order.
pub(super) fn parse(
    path: &Path,
    bytes: &[u8],
) -> Result<Vec<(String, Placement)>, DemonstrationError> {
    let mut frames: Vec<(String, Placement)> = Vec::new();
    for (i, line) in bytes.split(|b| *b == b'\n').enumerate() {
        let Some(comment) = line.strip_prefix(b"#") else {
            continue;
        };
        let comment = String::from_utf8_lossy(comment);
        let mut words = comment.split_whitespace();
        if words.next() != Some("frame") {
            continue;
        }
        let fault = |why: &str| DemonstrationError::Frame {
            path: path.to_owned(),
            line: i as u64 + 1,
            why: why.to_owned(),
        };
        let name = words.next().ok_or_else(|| fault("the name is missing"))?;
        if name.len() > MAX_NAME_BYTES {
            return Err(fault("the name is longer than 64 bytes"));
        }
        let numbers = words
            .map(|word| word.parse::<f64>().map_err(|_| word))
            .collect::<Result<Vec<_>, _>>()
            .map_err(|word| fault(&format!("{word:?} is not a number")))?;
        let placement = placement(&numbers).map_err(|why| fault(&why))?;
        if frames.iter().any(|(known, _)| known == name) {
            return Err(fault(&format!("{name:?} is placed a second time")));
        }
        frames.push((name.to_owned(), placement));
    }
    Ok(frames)
}

/// A placement from x, y, z (m) and, if there are seven numbers, a quaternion, scalar first.
pub(crate) fn placement(numbers: &[f64]) -> Result<Placement, String> {
    if !numbers.iter().all(|v| usable(*v)) {
        return Err("a number is not finite, or so large that the unit must be wrong".to_owned());
    }
    let (origin, turn) = match *numbers {
        [x, y, z] => (Vector3::new(x, y, z), UnitQuaternion::identity()),
        [x, y, z, qw, qx, qy, qz] => {
            let q = Quaternion::new(qw, qx, qy, qz);
            if !((q.norm() - 1.0).abs() <= NORM_SLACK) {
                return Err(format!("qw qx qy qz have norm {}, not 1", q.norm()));
            }
            (Vector3::new(x, y, z), UnitQuaternion::from_quaternion(q))
        }
        _ => {
            return Err(format!(
                "{} numbers, where three (x y z) or seven (x y z qw qx qy qz) are needed",
                numbers.len()
            ));
        }
    };
    Ok(Placement { origin, turn })
}

/// The lines that [`parse`] reads back.
pub(super) fn to_text(frames: &[(String, Placement)]) -> String {
    let mut text = String::new();
    for (name, Placement { origin: o, turn: q }) in frames {
        text += &format!("# frame {name} {} {} {}", o.x, o.y, o.z);
        if *q != UnitQuaternion::identity() {
            text += &format!(" {} {} {} {}", q.w, q.i, q.j, q.k);
        }
        text += "\n";
    }
    text
}
