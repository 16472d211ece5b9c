//! The joints of the skeletons we read, in the order of their files.

use super::{Fault, Format};

/// OpenNI/NiTE, as KARD has it (Gaglio, Lo Re, Morana 2014): 15 joints.
pub const OPENNI: [&str; 15] = [
    "head",
    "neck",
    "right_shoulder",
    "right_elbow",
    "right_hand",
    "left_shoulder",
    "left_elbow",
    "left_hand",
    "torso",
    "right_hip",
    "right_knee",
    "right_foot",
    "left_hip",
    "left_knee",
    "left_foot",
];

/// Kinect for Windows SDK 1.x, `JointType`: 20 joints.
pub const KINECT: [&str; 20] = [
    "hip_center",
    "spine",
    "shoulder_center",
    "head",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "left_hand",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "right_hand",
    "left_hip",
    "left_knee",
    "left_ankle",
    "left_foot",
    "right_hip",
    "right_knee",
    "right_ankle",
    "right_foot",
];

/// The place of `joint` in a frame. `right_hand`, `HandRight` and `Right hand` are the same joint.
pub(super) fn find(
    joint: &str,
    joints: &'static [&'static str],
    format: Format,
) -> Result<usize, Fault> {
    let wanted = words(joint);
    joints
        .iter()
        .position(|name| words(name) == wanted)
        .ok_or_else(|| Fault::UnknownJoint {
            joint: joint.to_owned(),
            format,
            known: joints.join(", "),
        })
}

/// Whether two names are the same joint.
pub(crate) fn same(a: &str, b: &str) -> bool {
    a == b || words(a) == words(b)
}

/// Its words in lower case, sorted.
fn words(name: &str) -> Vec<String> {
    let mut words: Vec<String> = vec![String::new()];
    let mut before_lower = false;
    for c in name.chars() {
        if !c.is_alphanumeric() || (c.is_uppercase() && before_lower) {
            words.push(String::new());
        }
        if let (true, Some(word)) = (c.is_alphanumeric(), words.last_mut()) {
            word.extend(c.to_lowercase());
        }
        before_lower = c.is_lowercase();
    }
    words.retain(|w| !w.is_empty());
    words.sort();
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_are_found_as_people_and_makers_write_them() {
        for name in ["right_hand", "HandRight", "Right hand", "right-hand"] {
            assert_eq!(find(name, &KINECT, Format::Kinect).unwrap(), 11, "{name}");
            assert_eq!(find(name, &OPENNI, Format::Kard).unwrap(), 4, "{name}");
        }
        let fault = find("right_wrist", &OPENNI, Format::Kard).unwrap_err();
        let message = fault.to_string();
        assert!(message.contains("right_hand, left_shoulder"), "{message}");
    }
}
