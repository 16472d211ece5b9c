//! Raw recordings to demonstrations, by the library and by the command.

use telemime_operator::ingest::{Cut, Imported, Options, import};
use telemime_sim::hand;

use crate::data::needs;

type Path3 = Vec<(f64, [f64; 3])>;

fn table(path: &Path3) -> String {
    let mut text = String::from("t,x,y,z\n");
    for (t, [x, y, z]) in path {
        text += &format!("{t},{x},{y},{z}\n");
    }
    text
}

fn cut(path: &Path3) -> Imported {
    let options = Options { cut: Cut::Repetitions, ..Options::default() };
    import(table(path).as_bytes(), &options).unwrap()
}

#[test]
fn measure() {
    // real: glitches found
    for set in ["demos/utd_mhad/a01_swipe_left", "demos/utd_mhad/a03_wave", "demos/utd_mhad/a09_circle_cw","demos/utd_mhad/a15_tennis_swing","demos/kard/a01_horizontal_arm_wave","demos/robottasks/pouring","demos/robottasks/openbox","demos/vr_hvr_ik/free_arm"] {
        let Some(dir) = needs(&format!("data/{set}")) else { return };
        let (mut n, mut g, mut fast, mut gl) = (0, 0, 0.0f64, 0.0f64);
        let mut at = vec![];
        for e in std::fs::read_dir(dir).unwrap() {
            let p = e.unwrap().path();
            let i = import(&std::fs::read(&p).unwrap(), &Options::default()).unwrap();
            n += i.report.frames; g += i.report.glitches_s.len();
            fast = fast.max(i.report.fastest_kept_m_s);
            gl = gl.max(i.report.fastest_glitch_m_s);
            if !i.report.glitches_s.is_empty() { at.push((p.file_stem().unwrap().to_str().unwrap().to_owned(), i.report.glitches_s.clone())); }
        }
        println!("{set}: {g} of {n}; kept {fast:.1} m/s, glitch {gl:.1}  {at:?}");
    }
    // sim
    let (mut n, mut g) = (0, 0);
    for seed in 0..40 {
        for index in 0..3 {
            let i = import(table(&hand::swing(seed, index)).as_bytes(), &Options::default()).unwrap();
            n += i.report.frames; g += i.report.glitches_s.len();
        }
    }
    println!("sim: {g} of {n}");
    // injected
    use rand::{RngExt, SeedableRng};
    let read = |set: &str| -> Vec<Path3> {
        let mut ps: Vec<_> = std::fs::read_dir(needs(&format!("data/{set}")).unwrap()).unwrap().map(|e| e.unwrap().path()).collect();
        ps.sort();
        ps.iter().map(|p| telemime_operator::demonstration::Demonstration::read_csv(p).unwrap().samples().iter().map(|s| (s.t_s, s.position.into())).collect()).collect()
    };
    let mut sets: Vec<(&str, Vec<Path3>)> = ["demos/utd_mhad/a01_swipe_left", "demos/utd_mhad/a03_wave", "demos/utd_mhad/a09_circle_cw","demos/utd_mhad/a15_tennis_swing","demos/kard/a01_horizontal_arm_wave","demos/vr_hvr_ik/free_arm"].iter().map(|s| (*s, read(s))).collect();
    sets.push(("sim", (0..30).map(|s| hand::swing(s, 1)).collect()));
    for (name, paths) in &sets {
        for run in [1usize, 2] {
            for size in [0.1, 0.2, 0.3, 0.5, 1.0] {
                let mut rng = rand_xoshiro::Xoshiro256PlusPlus::seed_from_u64(5);
                let (mut put, mut hits, mut found) = (0, 0, 0);
                for path in paths {
                    let mut path = path.clone();
                    let mut bad = vec![];
                    let mut i = 2;
                    while i + run + 2 < path.len() {
                        if rng.random_range(0.0..1.0) < 0.03 {
                            let d: [f64; 3] = [rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0f64)];
                            let n = d.iter().map(|x: &f64| x * x).sum::<f64>().sqrt();
                            for k in i..i + run { for c in 0..3 { path[k].1[c] += size * d[c] / n; } bad.push(path[k].0); }
                            i += 8;
                        }
                        i += 1;
                    }
                    let got = import(table(&path).as_bytes(), &Options::default()).unwrap().report.glitches_s;
                    put += bad.len(); found += got.len();
                    hits += got.iter().filter(|g| bad.iter().any(|b| (*g - b).abs() < 1e-6)).count();
                }
                println!("{name} run {run} size {size}: precision {:.3} recall {:.3} ({put})", hits as f64 / f64::max(1.0, found as f64), hits as f64 / put as f64);
            }
        }
    }
    // segmentation: without rest
    let (mut hit, mut all, mut found, mut methods) = (0, 0, 0, vec![]);
    for seed in 0..20 {
        let path = hand::swing(seed, 0);
        let i = cut(&path);
        let c = &i.report.cuts[0];
        methods.push(format!("{:?}{}", c.method, i.takes.len()));
        let turns = hand::turns(seed, 0);
        let best = (0..2).map(|side| turns.iter().skip(side).step_by(2).filter(|t| c.at_s.iter().any(|a| (a - **t).abs() < 0.15)).count()).enumerate().max_by_key(|x| x.1).unwrap();
        hit += best.1; all += turns.iter().skip(best.0).step_by(2).count(); found += c.at_s.len();
    }
    println!("continuous: {hit} of {all} true, {found} found; {methods:?}");

    // continuous, jitter, drops, noise
    for noise in [0.0, 0.01, 0.02] {
        let mut rng = rand_xoshiro::Xoshiro256PlusPlus::seed_from_u64(9);
        let (mut hit, mut all, mut found) = (0, 0, 0);
        for seed in 0..20 {
            let mut path = vec![];
            for (k, (t, x)) in hand::swing(seed, 0).into_iter().enumerate() {
                if k > 0 && rng.random_range(0.0..1.0) < 0.1 { continue; }
                path.push((t + if k == 0 { 0.0 } else { rng.random_range(-0.01..0.01) }, x.map(|x| x + noise * 1.7 * rng.random_range(-1.0..1.0))));
            }
            let i = cut(&path);
            let c = &i.report.cuts[0];
            let turns = hand::turns(seed, 0);
            print!("{:?}{} {:?}; ", c.method, c.at_s.len(), c.period_s);
            let best = (0..2).map(|side| turns.iter().skip(side).step_by(2).filter(|t| c.at_s.iter().any(|a| (a - **t).abs() < 0.15)).count()).enumerate().max_by_key(|x| x.1).unwrap();
            hit += best.1; all += turns.iter().skip(best.0).step_by(2).count(); found += c.at_s.len();
        }
        println!("jitter continuous noise {noise}: {hit} of {all} true, {found} found");
    }
    // rests
    let join = |paths: &[Path3], pause: f64| -> (Path3, Vec<(f64, f64)>) {
        let mut out: Path3 = vec![]; let mut pauses = vec![];
        for p in paths {
            let zero = match out.last() { None => 0.0, Some(&(t0, a)) => {
                let b = p[0].1; let n = (pause * 30.0) as usize;
                for k in 1..n { let u = k as f64 / n as f64; let s = u*u*u*(10.0-15.0*u+6.0*u*u); out.push((t0 + pause * u, std::array::from_fn(|d| a[d] + (b[d]-a[d])*s))); }
                pauses.push((t0, t0 + pause)); t0 + pause } };
            out.extend(p.iter().map(|(t, x)| (zero + t, *x)));
        }
        (out, pauses)
    };
    let score = |name: &str, groups: Vec<Vec<Path3>>, pause: f64| {
        let (mut hit, mut mid, mut all, mut found, mut m) = (0, 0, 0, 0, std::collections::BTreeMap::new());
        for g in groups {
            let (path, pauses) = join(&g, pause);
            let i = cut(&path);
            assert_eq!(i.report.accounted(), i.report.frames);
            for c in &i.report.cuts { *m.entry(format!("{:?}", c.method)).or_insert(0) += 1; found += c.at_s.len();
            all += pauses.len();
            hit += pauses.iter().filter(|(a, b)| c.at_s.iter().any(|t| *t > a - 0.15 && *t < b + 0.15)).count();
            mid += pauses.iter().filter(|(a, b)| c.at_s.iter().any(|t| (t - 0.5 * (a + b)).abs() < 0.15)).count();
            }
        }
        println!("joined {name} pause {pause}: {hit} within 0.15 of pause, {mid} of its middle, of {all}; {found} found {m:?}");
    };
    for pause in [0.1, 0.5, 1.0] {
        score("sim", (0..20).map(|s| (0..5).map(|i| hand::swing(s, i)).collect()).collect(), pause);
        for (name, paths) in &sets {
            let n = if name.contains("kard") { 3 } else if name.contains("utd") { 4 } else { continue };
            score(name, paths.chunks(n).map(|c| c.to_vec()).collect(), pause);
        }
    }
}
