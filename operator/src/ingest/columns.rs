//! Which column of a table is what.

use std::str::FromStr;

use super::Fault;

/// What a column may be, as `--columns` calls it.
const ROLES: [&str; 9] = ["t", "x", "y", "z", "qw", "qx", "qy", "qz", "grip"];

/// Which column of a table is what: by name, or by number from 1.
///
/// ```
/// use telemime_operator::ingest::Columns;
/// assert!("t=time,x=hand_x,y=hand_y,z=hand_z".parse::<Columns>().is_ok());
/// assert!("x=1,y=2,z=3".parse::<Columns>().is_ok());
/// assert!("x=1".parse::<Columns>().is_err());
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Columns([Option<String>; 9]);

/// Indices of the columns to read.
#[derive(Debug)]
pub(super) struct Picked {
    pub(super) t: Option<usize>,
    pub(super) position: [usize; 3],
    pub(super) orientation: Option<[usize; 4]>,
    pub(super) grip: Option<usize>,
}

impl FromStr for Columns {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut columns = Self::default();
        for pair in text.split(',') {
            let (role, name) = pair
                .split_once('=')
                .ok_or_else(|| format!("{pair:?} is not ROLE=COLUMN, as x=hand_x or x=2"))?;
            let (role, name) = (role.trim(), name.trim());
            let at = ROLES
                .iter()
                .position(|r| *r == role)
                .ok_or_else(|| format!("{role:?}: a column is one of {}", ROLES.join(", ")))?;
            if name.is_empty() || columns.0[at].is_some() {
                return Err(format!("{role} needs one column"));
            }
            columns.0[at] = Some(name.to_owned());
        }
        let there = |range: std::ops::Range<usize>| columns.0[range].iter().flatten().count();
        if there(1..4) != 3 {
            return Err("x, y and z are all needed".to_owned());
        }
        if !matches!(there(4..8), 0 | 4) {
            return Err("qw, qx, qy and qz come together".to_owned());
        }
        Ok(columns)
    }
}

impl Columns {
    /// Nothing said.
    pub(super) fn is_empty(&self) -> bool {
        self.0.iter().all(Option::is_none)
    }

    /// The columns in a table with this header, or with a first line like this and no header.
    pub(super) fn pick(
        &self,
        header: Option<&csv::StringRecord>,
        first: &csv::StringRecord,
        line: u64,
    ) -> Result<Picked, Fault> {
        let found = || match header {
            Some(header) => format!("{:?}", header.iter().collect::<Vec<_>>().join(",")),
            None => format!("{} columns without a header", first.len()),
        };
        let named = |name: &str| -> Vec<usize> {
            let columns = header.into_iter().flatten().enumerate();
            columns
                .filter(|(_, c)| *c == name)
                .map(|(i, _)| i)
                .collect()
        };
        let pick = |role: usize, name: &str| {
            let fault = |twice| Fault::Column {
                line,
                what: ROLES[role],
                column: name.to_owned(),
                twice,
                found: found(),
            };
            match named(name).as_slice() {
                [at] => Ok(*at),
                [] => name
                    .parse::<usize>()
                    .ok()
                    .and_then(|n| n.checked_sub(1))
                    .filter(|at| *at < first.len())
                    .ok_or_else(|| fault(false)),
                _ => Err(fault(true)),
            }
        };
        let mut at: [Option<usize>; 9] = [None; 9];
        if !self.is_empty() {
            for (role, name) in self.0.iter().enumerate() {
                at[role] = name.as_deref().map(|n| pick(role, n)).transpose()?;
            }
        } else if header.is_some() {
            for (role, name) in ROLES.iter().enumerate() {
                // Time, orientation and grip may be missing; half an orientation may not.
                let optional = role == 0 || role == 8;
                let turned = (4..8).contains(&role);
                let none = (4..8).all(|r| named(ROLES[r]).is_empty());
                if !(optional && named(name).is_empty() || turned && none) {
                    at[role] = Some(pick(role, name)?);
                }
            }
        } else if first.len() == 4 {
            at[..4].copy_from_slice(&[Some(0), Some(1), Some(2), Some(3)]);
        } else {
            return Err(Fault::NoHeader {
                line,
                found: first.len(),
            });
        }
        let [t, Some(x), Some(y), Some(z), qw, qx, qy, qz, grip] = at else {
            return Err(Fault::NoHeader {
                line,
                found: first.len(),
            });
        };
        let orientation = match (qw, qx, qy, qz) {
            (Some(w), Some(x), Some(y), Some(z)) => Some([w, x, y, z]),
            _ => None,
        };
        Ok(Picked {
            t,
            position: [x, y, z],
            orientation,
            grip,
        })
    }
}
