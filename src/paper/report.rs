//! What is printed, as text and as JSON.

use std::fmt::Write as _;

use serde::Serialize;

use super::metric::Scores;

/// One table's worth of figures.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Block {
    mae: Option<[f64; 2]>,
    mse: Option<[f64; 2]>,
    r2: [f64; 2],
    checkpoints: Option<usize>,
}

impl Block {
    pub(super) fn computed(scores: Scores, checkpoints: Option<usize>) -> Self {
        Self {
            mae: Some(scores.mae),
            mse: Some(scores.mse),
            r2: scores.r2,
            checkpoints,
        }
    }

    const fn printed(r2: [f64; 2], checkpoints: Option<usize>) -> Self {
        Self {
            mae: None,
            mse: None,
            r2,
            checkpoints,
        }
    }
}

/// A whole pipeline: tables I, II and III.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Pipeline {
    /// How it was made; for the text only.
    #[serde(skip)]
    pub(super) how: [String; 2],
    pub(super) checkpoints: usize,
    pub(super) learning: Block,
    pub(super) encoder: Block,
    pub(super) overall: Block,
}

impl Pipeline {
    /// The publication's tables for task 1. It prints R² to five digits; its other columns are not
    /// comparable (they were made with another run of its unseeded learning block).
    pub(super) fn published() -> Self {
        Self {
            how: ["published".into(), "published".into()],
            checkpoints: 14,
            learning: Block::printed([1.0, 0.98060], None),
            encoder: Block::printed([0.62514, 0.73572], Some(14)),
            overall: Block::printed([0.62514, 0.72158], Some(14)),
        }
    }
}

impl Pipeline {
    /// Which of several (I, II, III) R² comes nearest to this pipeline's.
    pub(super) fn nearest(&self, tried: &[[[f64; 2]; 3]]) -> usize {
        let own = [self.learning.r2, self.encoder.r2, self.overall.r2];
        let apart = |r2: &[[f64; 2]; 3]| -> f64 {
            let pairs = own.as_flattened().iter().zip(r2.as_flattened());
            pairs.map(|(a, b)| (a - b).abs()).sum()
        };
        let mut best = 0;
        for (i, r2) in tried.iter().enumerate() {
            if apart(r2) < apart(&tried[best]) {
                best = i;
            }
        }
        best
    }
}

/// Another way to learn, for comparison: table I only.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Learned {
    #[serde(skip)]
    pub(super) how: String,
    pub(super) learning: Block,
}

/// What stands beside the publication's learning block.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Beside {
    /// EM with its number of components.
    pub(super) plain_em: Learned,
    /// The mean of the demonstrations.
    pub(super) ceiling: Learned,
    /// Its method with other seeds.
    pub(super) spread: Spread,
}

/// Smallest and largest R² of its method over several seeds.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Spread {
    seeds: usize,
    learning: [[f64; 2]; 2],
    encoder: [[f64; 2]; 2],
    overall: [[f64; 2]; 2],
}

impl Spread {
    pub(super) fn of(tried: &[[[f64; 2]; 3]]) -> Self {
        let ends = |table: usize| {
            let mut ends = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
            for r2 in tried {
                for d in 0..2 {
                    ends[0][d] = ends[0][d].min(r2[table][d]);
                    ends[1][d] = ends[1][d].max(r2[table][d]);
                }
            }
            ends
        };
        Self {
            seeds: tried.len(),
            learning: ends(0),
            encoder: ends(1),
            overall: ends(2),
        }
    }

    fn rows(&self, of: impl Fn(&Self) -> [[f64; 2]; 2]) -> Vec<(String, Block)> {
        let [low, high] = of(self);
        let row = |what: &str, r2| {
            let how = format!("its method, {what} of {} seeds", self.seeds);
            (how, Block::printed(r2, None))
        };
        vec![row("lowest", low), row("highest", high)]
    }
}

/// Another way to read or choose checkpoints, for comparison.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Baseline {
    #[serde(skip)]
    pub(super) how: String,
    pub(super) checkpoints: usize,
    pub(super) encoder: Block,
    pub(super) overall: Block,
}

/// The baselines of one task.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Baselines {
    /// The publication's own checkpoints, read in time.
    pub(super) same_checkpoints_in_time: Baseline,
    /// As many samples as ours at even distances, read in time.
    pub(super) uniform_in_time: Baseline,
}

/// One task.
#[derive(Clone, Debug, Serialize)]
pub(super) struct TaskReport {
    pub(super) name: &'static str,
    pub(super) published: Option<Pipeline>,
    pub(super) reproduced: Pipeline,
    /// Null where nothing was learned.
    #[serde(flatten)]
    pub(super) beside: Option<Beside>,
    pub(super) ours: Pipeline,
    pub(super) baselines: Baselines,
}

/// All of it.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Report {
    pub(super) tasks: Vec<TaskReport>,
}

impl Report {
    /// Tables I–III of every task.
    pub(super) fn text(&self) -> String {
        let mut out = String::new();
        for task in &self.tasks {
            task.text(&mut out);
        }
        out
    }
}

impl TaskReport {
    fn text(&self, out: &mut String) {
        let both = |p: &dyn Fn(&Pipeline) -> (String, Block)| -> Vec<(String, Block)> {
            let published = self.published.iter().map(p);
            published
                .chain([p(&self.reproduced), p(&self.ours)])
                .collect()
        };
        let with_baselines =
            |p: &dyn Fn(&Pipeline) -> (String, Block), b: &dyn Fn(&Baseline) -> (String, Block)| {
                let mut rows = both(p);
                let baselines = [
                    b(&self.baselines.same_checkpoints_in_time),
                    b(&self.baselines.uniform_in_time),
                ];
                let ours = rows.len() - 1;
                rows.splice(ours..ours, baselines);
                rows
            };
        // Below its method: how far other seeds take it.
        let with_spread = |mut rows: Vec<(String, Block)>,
                           of: &dyn Fn(&Spread) -> [[f64; 2]; 2]| {
            if let Some(beside) = &self.beside {
                let at = usize::from(self.published.is_some()) + 1;
                rows.splice(at..at, beside.spread.rows(of));
            }
            rows
        };
        _ = writeln!(out, "{}", self.name);
        let mut learning = both(&|p| (p.how[0].clone(), p.learning));
        if let Some(beside) = &self.beside {
            let ours = learning.len() - 1;
            let row = |l: &Learned| (l.how.clone(), l.learning);
            learning.insert(ours, row(&beside.plain_em));
            learning.push(row(&beside.ceiling));
        }
        table(
            out,
            "Table I    learning: truth → inferred",
            &with_spread(learning, &|s| s.learning),
        );
        let encoder = with_baselines(&|p| (p.how[1].clone(), p.encoder), &|b| {
            (b.how.clone(), b.encoder)
        });
        table(
            out,
            "Table II   encoder: inferred → recovered",
            &with_spread(encoder, &|s| s.encoder),
        );
        let overall = with_baselines(&|p| (p.how[1].clone(), p.overall), &|b| {
            (b.how.clone(), b.overall)
        });
        table(
            out,
            "Table III  overall: truth → recovered",
            &with_spread(overall, &|s| s.overall),
        );
        out.push('\n');
    }
}

fn table(out: &mut String, title: &str, rows: &[(String, Block)]) {
    _ = writeln!(
        out,
        "  {title:<50}{:>9}{:>10}{:>10}{:>10}{:>10}{:>10}{:>8}",
        "R² x1", "R² x2", "MAE x1", "MAE x2", "MSE x1", "MSE x2", "points"
    );
    for (how, block) in rows {
        _ = write!(
            out,
            "    {how:<48}{:>9.5}{:>10.5}",
            block.r2[0], block.r2[1]
        );
        for pair in [block.mae, block.mse] {
            for d in 0..2 {
                match pair {
                    Some(v) => _ = write!(out, "{:>10}", short(v[d])),
                    None => _ = write!(out, "{:>10}", "–"),
                }
            }
        }
        match block.checkpoints {
            Some(n) => _ = writeln!(out, "{n:>8}"),
            None => _ = writeln!(out, "{:>8}", ""),
        }
    }
}

fn short(v: f64) -> String {
    if v != 0.0 && v.abs() < 1e-4 {
        format!("{v:.1e}")
    } else {
        format!("{v:.5}")
    }
}
