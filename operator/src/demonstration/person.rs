//! Whose performance a recording is, as its file name has it.

use std::str::FromStr;

use super::Demonstration;

/// Where a file name holds the person: `{}` stands for the name, `*` for any text.
///
/// The first star takes as much as it can, so that `*_{}_*` finds the last part but one of
/// `gesture_person_trial`, however many parts the gesture has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PersonPattern {
    before: String,
    after: String,
}

/// Why a text is no pattern.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} must have {{}} once, where a file name holds the person: *_{{}}_* finds \"ann\" in wave_ann_3.csv"
)]
pub struct PersonPatternError(String);

impl Default for PersonPattern {
    /// `*_{}_*`: `gesture_person_trial`.
    fn default() -> Self {
        Self {
            before: "*_".to_owned(),
            after: "_*".to_owned(),
        }
    }
}

impl std::fmt::Display for PersonPattern {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}{{}}{}", self.before, self.after)
    }
}

impl FromStr for PersonPattern {
    type Err = PersonPatternError;

    fn from_str(text: &str) -> Result<Self, PersonPatternError> {
        match text.split_once("{}") {
            Some((before, after)) if !after.contains("{}") => Ok(Self {
                before: before.to_owned(),
                after: after.to_owned(),
            }),
            _ => Err(PersonPatternError(text.to_owned())),
        }
    }
}

impl PersonPattern {
    /// The person in `name`; `None` if the name does not match.
    pub fn find<'a>(&self, name: &'a str) -> Option<&'a str> {
        let cuts = || (0..=name.len()).filter(|&at| name.is_char_boundary(at));
        // What stands before decides first, as long as possible; then the shortest person.
        cuts().rev().find_map(|from| {
            if !super::folder::matches(&self.before, &name[..from]) {
                return None;
            }
            let to = cuts()
                .filter(|&to| to >= from)
                .find(|&to| super::folder::matches(&self.after, &name[to..]))?;
            Some(&name[from..to])
        })
    }

    /// Who performs; empty if the name does not say.
    pub fn person<'a>(&self, demonstration: &'a Demonstration) -> &'a str {
        self.find(demonstration.name()).unwrap_or("")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn find<'a>(pattern: &str, name: &'a str) -> Option<&'a str> {
        pattern.parse::<PersonPattern>().unwrap().find(name)
    }

    #[test]
    fn the_person_is_found_where_the_pattern_says() {
        let usual = PersonPattern::default().to_string();
        assert_eq!(usual, "*_{}_*");
        for (pattern, name, person) in [
            (usual.as_str(), "a3_s1_t2", Some("s1")),
            (&usual, "high_wave_s1_t2", Some("s1")),
            (&usual, "demo01", None),
            (&usual, "a__t", Some("")),
            ("{}-*", "ann-wave-1", Some("ann")),
            ("take*by{}", "take 4 by ann", Some(" ann")),
            ("a3_{}_t*", "a3_s7_t1", Some("s7")),
            ("a3_{}_t*", "a4_s7_t1", None),
            ("{}", "Zoë", Some("Zoë")),
        ] {
            assert_eq!(find(pattern, name), person, "{pattern} in {name}");
        }
    }

    #[test]
    fn a_pattern_names_one_place() {
        for text in ["", "*", "{}_{}"] {
            assert!(text.parse::<PersonPattern>().is_err(), "{text}");
        }
    }
}
