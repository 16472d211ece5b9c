//! From text to samples: rows of fields, and what each format makes of them.

use nalgebra::Vector3;

use super::{Columns, Fault, Format, skeleton};

/// The largest number a file may hold: beyond it something is broken.
const LARGEST: f64 = 1e19;

/// A sample as the file states it, in its units; no position where the hand was not seen.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Raw {
    pub(super) line: u64,
    /// In the file's unit; none where it states no times.
    pub(super) t: Option<f64>,
    pub(super) position: Option<Vector3<f64>>,
    pub(super) orientation: Option<[f64; 4]>,
    pub(super) grip: Option<f64>,
    pub(super) inferred: bool,
}

/// What a file holds, as one format reads it.
#[derive(Debug)]
pub(super) struct Raws {
    pub(super) format: Format,
    pub(super) samples: Vec<Raw>,
}

/// One line's fields, and its number from 1.
struct Row {
    line: u64,
    fields: csv::StringRecord,
}

/// Reads text as `format`, or as what its first line looks like.
pub(super) fn read(
    bytes: &[u8],
    format: Option<Format>,
    joint: &str,
    columns: &Columns,
) -> Result<Raws, Fault> {
    let (rows, decimal_comma) = rows(bytes)?;
    let first = rows
        .iter()
        .find(|r| r.fields.iter().any(|f| number(f, decimal_comma).is_some()));
    let Some(first) = first else {
        return Err(Fault::Empty);
    };
    let headed = rows.first().is_some_and(|r| r.line != first.line);
    let format = format.unwrap_or(match first.fields.len() {
        // A skeleton of joints has no header: three names are those of a table's columns.
        3 if columns.is_empty() && !headed => Format::Kard,
        KINECT_FIELDS => Format::Kinect,
        _ => Format::Csv,
    });
    let samples = match format {
        Format::Kard => kard(&rows, joint, decimal_comma)?,
        Format::Kinect => kinect(&rows, joint, decimal_comma)?,
        Format::Csv => table(&rows, columns, decimal_comma)?,
        Format::Depth => return Err(Fault::NoFolder),
    };
    if samples.is_empty() {
        return Err(Fault::Empty);
    }
    Ok(Raws { format, samples })
}

/// Splits at `;`, tabs, commas or white space, whichever the first line has; where fields are not parted by
/// commas, a comma is a decimal point.
fn rows(bytes: &[u8]) -> Result<(Vec<Row>, bool), Fault> {
    let text = std::str::from_utf8(bytes).map_err(|e| Fault::NotText {
        line: 1 + bytes[..e.valid_up_to()]
            .iter()
            .filter(|b| **b == b'\n')
            .count() as u64,
    })?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let first = text
        .lines()
        .map(str::trim)
        .find(|l| !l.is_empty() && !l.starts_with('#'))
        .ok_or(Fault::Empty)?;
    // `1,5 2,0` is two numbers, `1, 5, 2` three: commas part fields unless something else does.
    let commas_at_ends = first.split_whitespace().any(|f| f.ends_with(','));
    let delimiter = match first {
        l if l.contains(';') => b';',
        l if l.contains('\t') => b'\t',
        l if l.contains(',') && (commas_at_ends || !l.contains(char::is_whitespace)) => b',',
        l if l.contains(',') && l.split(',').nth(1).is_some_and(|f| f.contains(' ')) => b' ',
        l if l.contains(',') => b',',
        _ => b' ',
    };
    let spaced: String;
    let (text, delimiter) = if delimiter == b' ' {
        let join = |l: &str| l.split_whitespace().collect::<Vec<_>>().join("\t");
        spaced = text.lines().map(join).collect::<Vec<_>>().join("\n");
        (spaced.as_str(), b'\t')
    } else {
        (text, delimiter)
    };
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .trim(csv::Trim::All)
        .comment(Some(b'#'))
        .delimiter(delimiter)
        .from_reader(text.as_bytes());
    // The reader counts remarks and blank lines to the record after them; a line a record, they are known.
    let lines: Vec<u64> = (1..)
        .zip(text.lines())
        .filter(|(_, l)| !l.is_empty() && !l.starts_with('#'))
        .map(|(n, _)| n)
        .collect();
    let mut rows = Vec::new();
    for (nth, record) in reader.records().enumerate() {
        let fields = record.map_err(|e| Fault::Csv {
            line: e.position().map_or(1, csv::Position::line),
            why: e.to_string(),
        })?;
        let counted = || fields.position().map_or(0, csv::Position::line);
        let line = lines.get(nth).copied().unwrap_or_else(counted);
        if fields.iter().any(|f| !f.is_empty()) {
            rows.push(Row { line, fields });
        }
    }
    // Where every line ends in a delimiter, what follows it is no field.
    let ends = |r: &Row| r.fields.len() > 1 && r.fields.iter().next_back() == Some("");
    if rows.iter().all(ends) {
        for row in &mut rows {
            row.fields.truncate(row.fields.len() - 1);
        }
    }
    Ok((rows, delimiter != b','))
}

fn number(field: &str, decimal_comma: bool) -> Option<f64> {
    if decimal_comma && field.contains(',') {
        field.replacen(',', ".", 1).parse().ok()
    } else {
        field.parse().ok()
    }
}

impl Row {
    fn expect(&self, expected: usize, format: Format) -> Result<(), Fault> {
        if self.fields.len() == expected {
            return Ok(());
        }
        Err(Fault::Fields {
            line: self.line,
            found: self.fields.len(),
            expected,
            format,
        })
    }

    /// The number in a field; not-a-number and nothing at all are the tracker's way to say that it saw nothing.
    fn seen(&self, at: usize, column: &str, decimal_comma: bool) -> Result<Option<f64>, Fault> {
        let text = self.fields.get(at).unwrap_or_default();
        if text.is_empty() {
            return Ok(None);
        }
        let value = number(text, decimal_comma).ok_or_else(|| Fault::NotANumber {
            line: self.line,
            column: column.to_owned(),
            text: text.to_owned(),
        })?;
        if value.is_nan() {
            return Ok(None);
        }
        if value.abs() > LARGEST {
            return Err(Fault::NotFinite {
                line: self.line,
                column: column.to_owned(),
                value,
            });
        }
        Ok(Some(value))
    }

    fn time(&self, at: usize, column: &str, decimal_comma: bool) -> Result<f64, Fault> {
        let time = self.seen(at, column, decimal_comma)?;
        time.ok_or_else(|| Fault::NotFinite {
            line: self.line,
            column: column.to_owned(),
            value: f64::NAN,
        })
    }

    /// Three numbers side by side.
    fn place(
        &self,
        at: [usize; 3],
        column: &str,
        comma: bool,
    ) -> Result<Option<Vector3<f64>>, Fault> {
        let mut place = Vector3::zeros();
        for (d, axis) in ["x", "y", "z"].iter().enumerate() {
            match self.seen(at[d], &format!("{axis} of {column}"), comma)? {
                Some(value) => place[d] = value,
                None => return Ok(None),
            }
        }
        Ok(Some(place))
    }
}

/// A joint a line, 15 lines a frame.
fn kard(rows: &[Row], joint: &str, comma: bool) -> Result<Vec<Raw>, Fault> {
    let joints = skeleton::OPENNI.len();
    let wanted = skeleton::find(joint, &skeleton::OPENNI, Format::Kard)?;
    for row in rows {
        row.expect(3, Format::Kard)?;
    }
    let frames = rows.chunks_exact(joints);
    if let [first, ..] = frames.remainder() {
        return Err(Fault::Truncated {
            line: first.line,
            found: frames.remainder().len(),
            expected: joints,
        });
    }
    frames
        .map(|frame| {
            let mut position = None;
            for (i, row) in frame.iter().enumerate() {
                let place = row.place([0, 1, 2], skeleton::OPENNI[i], comma)?;
                if i == wanted {
                    // The sensor itself: what is written for a joint that was not found.
                    position = place.filter(|p| *p != Vector3::zeros());
                }
            }
            Ok(Raw {
                line: frame[wanted].line,
                t: None,
                position,
                orientation: None,
                grip: None,
                inferred: false,
            })
        })
        .collect()
}

/// Time, and x y z state of every joint.
const KINECT_FIELDS: usize = 1 + 4 * skeleton::KINECT.len();

fn kinect(rows: &[Row], joint: &str, comma: bool) -> Result<Vec<Raw>, Fault> {
    let wanted = skeleton::find(joint, &skeleton::KINECT, Format::Kinect)?;
    let header = rows
        .first()
        .filter(|r| number(r.fields.get(0).unwrap_or_default(), comma).is_none());
    let frames = rows.get(usize::from(header.is_some())..).unwrap_or(&[]);
    let at = 1 + 4 * wanted;
    frames
        .iter()
        .map(|row| {
            row.expect(KINECT_FIELDS, Format::Kinect)?;
            let place = row.place([at, at + 1, at + 2], skeleton::KINECT[wanted], comma)?;
            let state = row.fields.get(at + 3).unwrap_or_default();
            let tracked = match state.to_ascii_lowercase().as_str() {
                "0" | "nottracked" => None,
                "1" | "inferred" => Some(true),
                "2" | "tracked" => Some(false),
                _ => {
                    return Err(Fault::State {
                        line: row.line,
                        joint: skeleton::KINECT[wanted].to_owned(),
                        text: state.to_owned(),
                    });
                }
            };
            Ok(Raw {
                line: row.line,
                t: Some(row.time(0, "the time", comma)?),
                position: place.filter(|p| tracked.is_some() && *p != Vector3::zeros()),
                orientation: None,
                grip: None,
                inferred: tracked == Some(true),
            })
        })
        .collect()
}

fn table(rows: &[Row], columns: &Columns, comma: bool) -> Result<Vec<Raw>, Fault> {
    let Some(first) = rows.first() else {
        return Err(Fault::Empty);
    };
    let field = |f: &str| f.is_empty() || number(f, comma).is_some();
    let header = (!first.fields.iter().all(field)).then_some(first);
    let picked = columns.pick(header.map(|h| &h.fields), &first.fields, first.line)?;
    let width = first.fields.len();
    let data = rows.get(usize::from(header.is_some())..).unwrap_or(&[]);
    data.iter()
        .map(|row| {
            row.expect(width, Format::Csv)?;
            let t = match picked.t {
                Some(at) => Some(row.time(at, "t", comma)?),
                None => None,
            };
            let mut position = row.place(picked.position, "the position", comma)?;
            let orientation = match picked.orientation {
                None => None,
                Some(at) => {
                    let mut q = [0.0; 4];
                    for (q, (at, name)) in q
                        .iter_mut()
                        .zip(at.into_iter().zip(["qw", "qx", "qy", "qz"]))
                    {
                        match row.seen(at, name, comma)? {
                            Some(value) => *q = value,
                            // A pose without its rotation was not seen.
                            None => position = None,
                        }
                    }
                    position.map(|_| q)
                }
            };
            let grip = match picked.grip {
                Some(at) => row.seen(at, "grip", comma)?,
                None => None,
            };
            if picked.grip.is_some() && grip.is_none() {
                position = None;
            }
            Ok(Raw {
                line: row.line,
                t,
                position,
                orientation,
                grip,
                inferred: false,
            })
        })
        .collect()
}
