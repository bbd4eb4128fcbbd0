"""How the page looks, on a screen by day and by night, and on paper."""

STYLE = """
:root { color-scheme: light dark; --paper: #fbfaf7; --card: #fff; --ink: #1c2128; --soft: #5d6672; --line: #dedbd3;
  --good: #0b7a5e; --bad: #c8501c; --accent: #2457c5; --warn: #9a6400; --wash: #f1efe9; }
@media (prefers-color-scheme: dark) { :root { --paper: #14171c; --card: #1b1f26; --ink: #e7e9ec; --soft: #9aa4b1;
  --line: #323944; --good: #3ecf9f; --bad: #ff8a4c; --accent: #7ba6ff; --warn: #e5b454; --wash: #232831; } }
* { box-sizing: border-box; }
body { background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", Roboto, sans-serif;
  margin: 0 auto; max-width: 1080px; padding: 2.2rem 1.2rem 3rem; }
header { border-bottom: 1px solid var(--line); padding-bottom: 1.2rem; }
.kicker { color: var(--soft); font-size: 13px; letter-spacing: .02em; margin: 0 0 .4rem; overflow-wrap: anywhere; }
h1 { font-size: 2rem; line-height: 1.2; margin: 0; font-weight: 650; letter-spacing: -.01em;
  overflow-wrap: anywhere; }
h1 .good { color: var(--good); } h1 .bad { color: var(--bad); }
header p.why { margin: .5rem 0 0; max-width: 60rem; font-size: 16px; }
h2 { font-size: 1.12rem; margin: 2.4rem 0 .7rem; font-weight: 650; }
h3 { font-size: .95rem; margin: 1.2rem 0 .4rem; font-weight: 600; color: var(--soft); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: .7rem; margin: 1.3rem 0 0; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 9px; padding: .65rem .85rem; }
.card b { display: block; font-size: 1.35rem; font-weight: 620; font-variant-numeric: tabular-nums;
  line-height: 1.25; }
.card span { color: var(--soft); font-size: 12.5px; display: block; line-height: 1.35; }
.hint { border-left: 4px solid var(--accent); background: var(--wash); padding: .7rem 1rem;
  border-radius: 0 8px 8px 0;
  margin: 1.2rem 0 0; } .hint.conflict { border-color: var(--bad); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13.5px; font-variant-numeric: tabular-nums; width: 100%; }
th, td { padding: .28rem .7rem .28rem 0; text-align: right; border-bottom: 1px solid var(--line);
  vertical-align: middle; }
th { color: var(--soft); font-weight: 550; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; overflow-wrap: anywhere; }
table.words td { text-align: left; overflow-wrap: anywhere; } table.words td:first-child { color: var(--soft);
  width: 11rem; }
table.names td:first-child { white-space: nowrap; overflow-wrap: normal; }
table.matrix td { font-size: 12.5px; white-space: nowrap; padding: .3rem .5rem; text-align: center; }
table.matrix { width: auto; } table.matrix th, table.matrix td { text-align: center; }
td:has(> .bar) { text-align: left; } .tint { padding: .1rem .35rem; border-radius: 3px; }
.bar { display: inline-block; height: .6em; border-radius: 2px; background: var(--accent); vertical-align: baseline; }
.bar.good { background: var(--good); } td.left { text-align: left; }
.note, figcaption { color: var(--soft); font-size: 13px; }
figure { margin: 0 0 1rem; } figcaption { margin-top: .4rem; }
svg { display: block; width: 100%; height: auto; border-radius: 6px; }
svg.store { position: absolute; width: 0; height: 0; }
svg text { fill: currentColor; font: 12px system-ui, sans-serif; }
svg .empty { fill: var(--wash); stroke: var(--line); }
.overlay input { position: absolute; opacity: 0; }
.overlay label { display: inline-block; cursor: pointer; font-size: 13.5px; margin: 0 .9rem .5rem 0;
  user-select: none; }
.overlay label::before { content: ""; display: inline-block; width: .8em; height: .8em; border-radius: 50%;
  margin-right: .4em;
  border: 2px solid; vertical-align: -1px; }
.overlay label.inlier, .overlay label.outlier { color: var(--ink); }
.overlay label.inlier::before { border-color: #12b886; } .overlay label.outlier::before { border-color: #ff6b2b; }
.overlay input:checked + label.inlier::before { background: #12b886; }
.overlay input:checked + label.outlier::before { background: #ff6b2b; }
.overlay input:focus-visible + label { outline: 2px solid var(--accent); outline-offset: 3px; }
#show-inlier:not(:checked) ~ svg .inlier, #show-outlier:not(:checked) ~ svg .outlier { display: none; }
.overlay path { fill: none; stroke-linecap: round; }
.overlay path.inlier { stroke: #2ee6a6; } .overlay path.halo { stroke: #06251b; }
.overlay path.residual { stroke: #ffe14d; } .overlay path.outlier { stroke: #ff6b2b; }
.overlay path.far { stroke: #ff6b2b; stroke-opacity: .45; }
.pair path { fill: none; stroke-width: 1; stroke-opacity: .75; } .pair circle { stroke: none; }
.pair .lines circle[style] { stroke-width: 0; fill: #fff; fill-opacity: .9; }
.pair path.outlier { stroke: #ff6b2b; stroke-opacity: .4; stroke-dasharray: 4 4; }
  .pair circle.outlier { fill: #ff6b2b; }
.plan svg { background: var(--card); border: 1px solid var(--line); }
.plan path { fill: none; stroke-linejoin: round; }
.plan .points { stroke: var(--soft); stroke-opacity: .38; stroke-width: 1.8; stroke-linecap: round; }
.plan .used { fill: var(--accent); fill-opacity: .3; stroke: var(--accent); stroke-width: 1.2; }
.plan .unused { fill: var(--soft); fill-opacity: .1; stroke: var(--soft); stroke-opacity: .45; stroke-width: 1; }
.plan .pose { fill: var(--bad); fill-opacity: .45; stroke: var(--bad); stroke-width: 1.8; }
.plan .pose.other { fill-opacity: .15; stroke-dasharray: 4 3; }
.plan .ellipse { fill: var(--bad); fill-opacity: .2; stroke: var(--bad); stroke-width: 1.2; }
.plan .lens { fill: var(--card); fill-opacity: .93; stroke: var(--line); stroke-width: 1.2; }
.plan .lead { stroke: var(--line); stroke-width: 1.2; } .plan .centre { fill: var(--bad); }
.plan path.bar { stroke: var(--soft); stroke-width: 1.3; } .plan text { fill: var(--soft); }
.plan text.name { fill: var(--bad); font-weight: 650; font-size: 14px; }
.key::before { content: ""; display: inline-block; width: .75em; height: .75em; margin: 0 .35em 0 .8em;
  border: 1.5px solid;
  border-radius: 2px; vertical-align: -1px; }
.key.used::before { border-color: var(--accent); background: color-mix(in srgb, var(--accent) 30%, transparent); }
.key.unused::before { border-color: var(--soft); } .key.pose::before { border-color: var(--bad);
  background: color-mix(in srgb, var(--bad) 45%, transparent); }
.target svg { max-width: 640px; }
.histogram svg { max-width: 460px; } .histogram .inlier { fill: #12b886; } .histogram .outlier { fill: #ff6b2b; }
.histogram .axis { stroke: var(--soft); } .histogram text { fill: var(--soft); font-size: 10px; }
.ok { color: var(--good); } .conflict-mark { color: var(--bad); font-weight: 600; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: .8rem; color: var(--soft);
  font-size: 12.5px; }
@media print { :root { --paper: #fff; --card: #fff; --ink: #000; --soft: #444; --line: #bbb; --good: #0b7a5e;
  --bad: #b8440f;
    --accent: #2457c5; --wash: #f4f4f4; }
  body { max-width: none; padding: 0; font-size: 11pt; print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  section, figure, table, .card { break-inside: avoid; } h2 { break-after: avoid; }
  .overlay label { cursor: auto; } }
"""
